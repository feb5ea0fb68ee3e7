// A wall of episodes that play, each to its end before a newer one takes its place; and beliefs.

import { brief, byId, clock, el, say } from "./monitor-dom.js";
import { draw, frames, rate, words } from "./monitor-drawings.js";
import { faint, ink } from "./monitor-charts.js";

const TILES = 8;
const HOLD_S = 1.2; // the end of an episode stays so long
const STILL_S = 3; // without motion, a drawing stays so long
const calm = matchMedia("(prefers-reduced-motion: reduce)");

const KEYS = {
  room: "Square: the goal. Orange, crossed: actions that the adversary overrode.",
  sticks: "Bar below: the adversary's force, of its largest.",
  paths: "From above. Square: the goal; line: hand; dashes: object.",
};

/** One canvas that plays an episode; `open` is called when it is chosen. */
export class Tile {
  constructor(open) {
    this.canvas = el("canvas", { role: "img" });
    this.caption = el("span", { class: "caption small" });
    this.element = open ? el("button", { type: "button", class: "tile" }, this.canvas, this.caption) : el("figure", { class: "tile" }, this.canvas, this.caption);
    if (open) this.element.addEventListener("click", () => this.episode && open(this.episode.name));
    this.held = false;
    for (const [event, held] of [["pointerenter", true], ["pointerleave", false], ["focus", true], ["blur", false]]) {
      this.element.addEventListener(event, () => (this.held = held && (event !== "focus" || this.element.matches(":focus-visible"))));
    }
    this.episode = null;
    this.at = 0;
  }

  show(episode) {
    this.episode = episode;
    this.at = 0;
    this.element.title = `${episode.identity}, ${episode.worker}, ${clock(episode.time)}`;
    this.canvas.setAttribute("aria-label", `${episode.name}: ${words(episode.drawing)}; return ${brief(episode.episode_return)}`);
    this.caption.replaceChildren(el("span", {}, episode.name), el("b", {}, brief(episode.episode_return)));
    this.stale = true;
  }

  /** Go on by so many seconds; true once the episode has been seen to its end. */
  play(seconds, moving) {
    if (!this.episode) return true;
    const speed = rate(this.episode.drawing);
    const last = frames(this.episode.drawing) - 1;
    if (!moving || calm.matches) {
      if (calm.matches) this.at += seconds;
      draw(this.canvas, this.episode.drawing, calm.matches ? last : this.at, calm.matches);
      return calm.matches && moving && this.at > STILL_S;
    }
    if (!this.held) this.at += seconds * speed;
    draw(this.canvas, this.episode.drawing, this.at);
    return this.at > last + HOLD_S * speed;
  }
}

export class Episodes {
  constructor(store, open) {
    this.store = store;
    this.tiles = Array.from({ length: TILES }, () => new Tile(open));
    this.extra = new Set(); // tiles that play elsewhere on the page
    this.moving = true;
    this.last = 0;
    const button = byId("motion");
    button.addEventListener("click", () => {
      this.moving = !this.moving;
      button.setAttribute("aria-pressed", String(!this.moving));
    });
    requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    requestAnimationFrame((next) => this.#frame(next));
    const seconds = (now - this.last) / 1000;
    if (document.hidden || seconds < (calm.matches ? 1 : 1 / 30)) return;
    this.last = now;
    const step = Math.min(seconds, 1);
    for (const tile of this.tiles) if (tile.play(step, this.moving)) this.#next(tile);
    for (const tile of this.extra) if (tile.play(step, this.moving)) tile.at = 0;
  }

  /** The newest episode that no tile shows; the same once more if there is none. */
  #next(tile) {
    const shown = new Set(this.tiles.map((each) => each.episode?.identity));
    const waiting = [...this.store.episodes.values()].reverse().find((episode) => !shown.has(episode.identity) && episode.time >= (tile.episode?.time ?? 0));
    if (waiting) {
      if (!tile.element.isConnected) byId("episodes").append(tile.element);
      tile.show(waiting);
      const kinds = new Set(this.tiles.map((each) => each.episode?.drawing.kind).filter(Boolean));
      say(byId("episodes-key"), [...kinds].map((kind) => KEYS[kind]).join(" "));
    }
    tile.at = 0;
  }

  /** Another run, or an earlier moment: begin anew. */
  clear() {
    for (const tile of this.tiles) {
      tile.episode = null;
      tile.element.remove();
    }
  }
}

/** What T_theta and the exact posterior believe about the goal, a pair of maps a worker. */
export class Beliefs {
  constructor() {
    this.pairs = new Map();
  }

  draw(beliefs) {
    byId("beliefs-card").hidden = !Object.keys(beliefs).length;
    for (const name of this.pairs.keys()) {
      if (name in beliefs) continue;
      this.pairs.get(name).element.remove();
      this.pairs.delete(name);
    }
    for (const [worker, belief] of Object.entries(beliefs)) {
      const pair = this.pairs.get(worker) ?? this.#pair(worker);
      const apart = belief.implied.reduce((sum, value, index) => sum + Math.abs(value - belief.exact[index]), 0) / 2;
      say(pair.title, worker);
      pair.title.title = belief.identity;
      say(pair.words, `total variation ${brief(apart)}`);
      const top = Math.max(...belief.implied, ...belief.exact);
      for (const [side, law] of [[pair.implied, belief.implied], [pair.exact, belief.exact]]) {
        heat(side, belief, law, top);
        const peak = law.indexOf(Math.max(...law));
        const cell = `${Math.floor(peak / belief.size)}, ${peak % belief.size}`;
        side.setAttribute("aria-label", `${side.dataset.what}: most likely cell ${cell} with ${brief(law[peak])}; goal at ${belief.goal.join(", ")}`);
      }
    }
  }

  #pair(worker) {
    const map = (what) => el("canvas", { role: "img", "data-what": what, class: "map" });
    const pair = { title: el("p", { class: "small strong" }), words: el("p", { class: "small muted" }), implied: map("Implied by the model"), exact: map("Exact posterior") };
    const figure = (canvas) => el("figure", {}, canvas, el("figcaption", { class: "small muted" }, canvas.dataset.what.split(" ")[0]));
    pair.element = el("div", { class: "stack" }, pair.title, el("div", { class: "pair" }, figure(pair.implied), figure(pair.exact)), pair.words);
    byId("beliefs").append(pair.element);
    this.pairs.set(worker, pair);
    return pair;
  }
}

function heat(canvas, { size, goal }, law, top) {
  const scale = devicePixelRatio || 1;
  const side = Math.round(canvas.clientWidth * scale);
  if (!side) return;
  canvas.width = canvas.height = side;
  const ctx = canvas.getContext("2d");
  const cell = side / size;
  ctx.fillStyle = ink("--raised");
  ctx.fillRect(0, 0, side, side);
  law.forEach((value, index) => {
    const [x, y] = [Math.floor(index / size), index % size];
    ctx.fillStyle = faint("--series-1", top > 0 ? value / top : 0);
    ctx.fillRect(x * cell, side - (y + 1) * cell, cell - scale, cell - scale);
  });
  ctx.strokeStyle = ink("--ok");
  ctx.lineWidth = 2 * scale;
  ctx.strokeRect(goal[0] * cell + scale, side - (goal[1] + 1) * cell + scale, cell - 3 * scale, cell - 3 * scale);
}
