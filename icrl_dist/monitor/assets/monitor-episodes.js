// Tiles that play episodes, each to its end before a newer one replaces it; and maps of beliefs.

import { brief, byId, clock, el, setText } from "./monitor-dom.js";
import { description, draw, frames, rate } from "./monitor-drawings.js";
import { faint, ink } from "./monitor-charts.js";

const TILES = 8;
const HOLD_S = 1.2; // time for which the end of an episode is shown
const STILL_S = 3; // time for which a drawing is shown if the user prefers reduced motion
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

const KEYS = {
  room: "Square: the goal. Orange with a cross: steps that the adversary disturbed.",
  sticks: "Bar: the adversary's force, relative to its maximum. Marks on the ground: meters.",
  arm: "From the side. Green square: the goal; orange: the object. Only the hand is observed: the arm's angles are assumed.",
  paths: "From above. Square: the goal; line: hand; dashes: object.",
};

/** A canvas that plays an episode; a click calls `open`. */
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
    this.canvas.setAttribute("aria-label", `${episode.name}: ${description(episode.drawing)}; return ${brief(episode.episode_return)}`);
    this.caption.replaceChildren(el("span", {}, episode.name), el("b", {}, brief(episode.episode_return)));
    this.stale = true;
  }

  /** Advance by `seconds`; true once the episode has been played to its end. */
  play(seconds, moving) {
    if (!this.episode) return true;
    const speed = rate(this.episode.drawing);
    const last = frames(this.episode.drawing) - 1;
    if (!moving || reducedMotion.matches) {
      if (reducedMotion.matches) this.at += seconds;
      draw(this.canvas, this.episode.drawing, reducedMotion.matches ? last : this.at, reducedMotion.matches);
      return reducedMotion.matches && moving && this.at > STILL_S;
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
    this.extra = new Set(); // further tiles on the page
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
    if (document.hidden || seconds < (reducedMotion.matches ? 1 : 1 / 30)) return;
    this.last = now;
    const step = Math.min(seconds, 1);
    for (const tile of this.tiles) if (tile.play(step, this.moving)) this.#next(tile);
    for (const tile of this.extra) if (tile.play(step, this.moving)) tile.at = 0;
  }

  /** Show the newest episode that no tile shows; if there is none, repeat the same. */
  #next(tile) {
    const shown = new Set(this.tiles.map((each) => each.episode?.identity));
    const waiting = [...this.store.episodes.values()].reverse().find((episode) => !shown.has(episode.identity) && episode.time >= (tile.episode?.time ?? 0));
    if (waiting) {
      if (!tile.element.isConnected) byId("episodes").append(tile.element);
      byId("episodes").classList.toggle("large", waiting.drawing.kind !== "room");
      tile.show(waiting);
      const kinds = new Set(this.tiles.map((each) => each.episode?.drawing.kind).filter(Boolean));
      setText(byId("episodes-key"), [...kinds].map((kind) => KEYS[kind]).join(" "));
    }
    tile.at = 0;
  }

  /** Remove all episodes, for another run or an earlier position in a recording. */
  clear() {
    for (const tile of this.tiles) {
      tile.episode = null;
      tile.element.remove();
    }
  }
}

/** For each worker a pair of maps: the posterior over goals that T_theta implies, and the exact one. */
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
      setText(pair.title, worker);
      pair.title.title = belief.identity;
      setText(pair.distance, `total variation ${brief(apart)}`);
      const top = Math.max(...belief.implied, ...belief.exact);
      for (const [map, probs] of [[pair.implied, belief.implied], [pair.exact, belief.exact]]) {
        drawHeat(map, belief, probs, top);
        const peak = probs.indexOf(Math.max(...probs));
        const cell = `${Math.floor(peak / belief.size)}, ${peak % belief.size}`;
        map.setAttribute("aria-label", `${map.dataset.what}: most likely cell ${cell} with ${brief(probs[peak])}; goal at ${belief.goal.join(", ")}`);
      }
    }
  }

  #pair(worker) {
    const map = (what) => el("canvas", { role: "img", "data-what": what, class: "map" });
    const pair = { title: el("p", { class: "small strong" }), distance: el("p", { class: "small muted" }), implied: map("Implied by the model"), exact: map("Exact posterior") };
    const figure = (canvas) => el("figure", {}, canvas, el("figcaption", { class: "small muted" }, canvas.dataset.what.split(" ")[0]));
    pair.element = el("div", { class: "stack" }, pair.title, el("div", { class: "pair" }, figure(pair.implied), figure(pair.exact)), pair.distance);
    byId("beliefs").append(pair.element);
    this.pairs.set(worker, pair);
    return pair;
  }
}

function drawHeat(canvas, { size, goal }, probs, top) {
  const scale = devicePixelRatio || 1;
  const side = Math.round(canvas.clientWidth * scale);
  if (!side) return;
  canvas.width = canvas.height = side;
  const ctx = canvas.getContext("2d");
  const cell = side / size;
  ctx.fillStyle = ink("--raised");
  ctx.fillRect(0, 0, side, side);
  probs.forEach((value, index) => {
    const [x, y] = [Math.floor(index / size), index % size];
    ctx.fillStyle = faint("--series-1", top > 0 ? value / top : 0);
    ctx.fillRect(x * cell, side - (y + 1) * cell, cell - scale, cell - scale);
  });
  ctx.strokeStyle = ink("--ok");
  ctx.lineWidth = 2 * scale;
  ctx.strokeRect(goal[0] * cell + scale, side - (goal[1] + 1) * cell + scale, cell - 3 * scale, cell - 3 * scale);
}
