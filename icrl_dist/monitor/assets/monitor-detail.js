// One variation: its adversary, its curves, its newest episode, and where each came from.

import { Chart, axis, line } from "./monitor-charts.js";
import { Tile } from "./monitor-episodes.js";
import { brief, byId, clock, el, plural, say } from "./monitor-dom.js";
import { factsOf } from "./monitor-panels.js";

const INKS = ["--series-1", "--series-4", "--series-6"];

/** The phases whose own optimum is known: each round has another adversary. */
const solved = (row) => row.phases.filter((phase) => phase.optimum !== null);

function phaseWords(phase) {
  const optimal = phase.optimum === null ? "" : `, optimal ${brief(phase.optimum)}`;
  return `${phase.name}: ${plural(phase.returns.length, "episode")}, last ${brief(phase.returns.at(-1))}${optimal}`;
}

export class Detail {
  constructor(store, episodes) {
    this.store = store;
    this.episodes = episodes;
    this.dialog = byId("detail");
    this.name = null;
    this.row = null;
    this.tile = new Tile(null);
    this.chart = new Chart(byId("detail-chart"), () => this.#options());
    byId("detail-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("close", () => {
      this.name = this.row = null;
      this.chart.forget();
      this.episodes.extra.delete(this.tile);
      this.opener?.focus();
    });
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
  }

  async open(name) {
    this.opener = document.activeElement;
    this.name = name;
    this.seen = null;
    say(byId("detail-title"), `Variation ${name}`);
    say(byId("detail-said"), "");
    byId("detail-lineage").replaceChildren();
    byId("detail-episode").replaceChildren();
    this.tile.episode = null;
    if (!this.dialog.open) this.dialog.showModal();
    await this.refresh();
  }

  /** Ask for it again, if it has changed. */
  async refresh() {
    const told = this.store.variations.get(this.name);
    if (!this.name || this.asking || told === this.seen) return;
    this.asking = true;
    try {
      const answer = await fetch(`/variation/${this.name}`);
      if (!answer.ok) return say(byId("detail-said"), "The server no longer knows this variation.");
      const row = await answer.json();
      if (row.name === this.name) {
        this.seen = told;
        this.#show(row);
      }
    } catch {
      say(byId("detail-said"), "The server does not answer.");
    } finally {
      this.asking = false;
    }
  }

  #show(row) {
    this.row = row;
    byId("detail-facts").replaceChildren(...factsOf(row).map(([name, text]) => el("div", {}, el("dt", {}, name), el("dd", {}, text))));
    const trials = [...new Set(row.phases.flatMap((phase) => phase.trials))].sort((one, other) => one - other);
    const columns = row.phases.map((phase) => {
      const returns = new Map(phase.trials.map((trial, index) => [trial, phase.returns[index]]));
      return trials.map((trial) => returns.get(trial) ?? null);
    });
    const during = (phase, trial) => trial >= phase.trials[0] && trial <= phase.trials.at(-1);
    const bounds = solved(row).map((phase) => trials.map((trial) => (during(phase, trial) ? phase.optimum : null)));
    const x = trials.map((trial) => trial + 1);
    this.chart.draw([x, ...bounds, ...columns], JSON.stringify([row.name, row.phases.map((phase) => [phase.name, phase.optimum])]));
    say(byId("detail-summary"), row.phases.map(phaseWords).join("; "));
    if (row.episode && row.episode.identity !== this.tile.episode?.identity) {
      byId("detail-episode").replaceChildren(this.tile.element);
      this.tile.show(row.episode);
      this.episodes.extra.add(this.tile);
    }
    this.#lineage(row.lineage);
  }

  #options() {
    const { row } = this;
    const newest = row.phases.length - 1;
    const bounds = solved(row).map((phase) => {
      const now = phase === row.phases[newest];
      return line(now ? "optimum, expected" : `optimum, ${phase.name}`, "--ok", { width: now ? 1.5 : 1, dash: now ? [6, 4] : [2, 4] });
    });
    const lines = row.phases.map((phase, index) => line(phase.name, INKS[newest - index] ?? INKS[2], { width: index === newest ? 2.5 : 1.5, points: { show: phase.returns.length < 40, size: 5 } }));
    return {
      scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), (high ?? 1) * 1.06 || 1] } },
      axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis()],
      series: [{ label: "episode" }, ...bounds, ...lines],
    };
  }

  #lineage(rows) {
    const head = ["Identity", "Return", "Weights", "Digest", "Worker", "Sent at", "Explain"];
    const body = rows.toReversed().map((row) => {
      const words = `icrl-dist explain runs/${this.store.run.name} ${row.identity}`;
      const copy = el("button", { type: "button", class: "small-button", title: words, "aria-label": `Copy: ${words}` }, "Copy command");
      copy.addEventListener("click", () => this.#copy(words));
      return el(
        "tr",
        {},
        el("th", { scope: "row", class: "mono" }, row.identity),
        el("td", { class: "number" }, brief(row.episode_return)),
        el("td", {}, row.policy_version >= 0 ? `T^${row.policy_version}` : "none"),
        el("td", { class: "mono", title: row.weights_digest }, row.weights_digest.slice(0, 12) || "–"),
        el("td", {}, row.worker),
        el("td", {}, clock(row.time)),
        el("td", {}, copy),
      );
    });
    const focused = document.activeElement?.getAttribute("aria-label");
    byId("detail-lineage").replaceChildren(
      el("table", {}, el("thead", {}, el("tr", {}, ...head.map((name) => el("th", { scope: "col", class: name === "Return" ? "number" : null }, name)))), el("tbody", {}, ...body)),
    );
    if (focused) [...byId("detail-lineage").querySelectorAll("button")].find((button) => button.getAttribute("aria-label") === focused)?.focus();
  }

  async #copy(words) {
    try {
      await navigator.clipboard.writeText(words);
      say(byId("detail-said"), `Copied: ${words}`);
    } catch {
      say(byId("detail-said"), words);
    }
  }
}
