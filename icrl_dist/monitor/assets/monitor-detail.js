// The dialog of one variation: its adversary, returns, newest episode and lineage.

import { Chart, axis, line } from "./monitor-charts.js";
import { Tile } from "./monitor-episodes.js";
import { brief, byId, clock, el, plural, setText, withGaps } from "./monitor-dom.js";
import { factsOf } from "./monitor-panels.js";

const INKS = ["--series-1", "--series-4", "--series-6"];

/** The phases with a known optimum; it differs by phase, because each round has another adversary. */
const solved = (row) => row.phases.filter((phase) => phase.optimum !== null);

function phaseText(phase) {
  const optimal = phase.optimum === null ? "" : `, optimal ${brief(phase.optimum)}`;
  return `${phase.name}: ${plural(phase.returns.length, "episode")}, last ${brief(phase.returns.at(-1))}${optimal}`;
}

export class Detail {
  /** `runs`: names the run in addresses. */
  constructor(store, episodes, runs) {
    this.store = store;
    this.runs = runs;
    this.episodes = episodes;
    this.dialog = byId("detail");
    this.name = null;
    this.row = null;
    this.tile = new Tile(null);
    this.chart = new Chart(byId("detail-chart"), () => this.#options());
    byId("detail-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("close", () => {
      this.name = this.row = null;
      this.chart.clear();
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
    this.shown = null;
    setText(byId("detail-title"), `Variation ${name}`);
    setText(byId("detail-note"), "");
    byId("detail-lineage").replaceChildren();
    byId("detail-episode").replaceChildren();
    this.tile.episode = null;
    if (!this.dialog.open) this.dialog.showModal();
    await this.refresh();
  }

  /** Fetch the variation again if it has changed. */
  async refresh() {
    const newest = this.store.variations.get(this.name);
    if (!this.name || this.fetching || newest === this.shown) return;
    this.fetching = true;
    try {
      const answer = await fetch(`/variation/${this.name}${this.runs.query()}`);
      if (!answer.ok) return setText(byId("detail-note"), "The server has no data of this variation any more.");
      const row = await answer.json();
      if (row.name === this.name) {
        this.shown = newest;
        this.#show(row);
      }
    } catch {
      setText(byId("detail-note"), "No answer from the server.");
    } finally {
      this.fetching = false;
    }
  }

  #show(row) {
    this.row = row;
    byId("detail-facts").replaceChildren(...factsOf(row).map(([name, text]) => el("div", {}, el("dt", {}, name), el("dd", {}, text))));
    const trials = withGaps(row.phases.flatMap((phase) => phase.trials));
    const columns = row.phases.map((phase) => {
      const returns = new Map(phase.trials.map((trial, index) => [trial, phase.returns[index]]));
      return trials.map((trial) => returns.get(trial) ?? null);
    });
    const during = (phase, trial) => trial >= phase.trials[0] && trial <= phase.trials.at(-1);
    const bounds = solved(row).map((phase) => trials.map((trial) => (during(phase, trial) ? phase.optimum : null)));
    const x = trials.map((trial) => trial + 1);
    this.chart.draw([x, ...bounds, ...columns], JSON.stringify([row.name, row.phases.map((phase) => [phase.name, phase.optimum])]));
    setText(byId("detail-summary"), row.phases.map(phaseText).join("; "));
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
    const head = ["Identity", "Return", "Version", "Weights digest", "Worker", "Sent at", "Explain"];
    const body = rows.toReversed().map((row) => {
      const command = `icrl-dist explain ${this.runs.folder ?? "runs"}/${this.store.run.name} ${row.identity}`;
      const copy = el("button", { type: "button", class: "small-button", title: command, "aria-label": `Copy: ${command}` }, "Copy command");
      copy.addEventListener("click", () => this.#copy(command));
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

  async #copy(command) {
    try {
      await navigator.clipboard.writeText(command);
      setText(byId("detail-note"), `Copied: ${command}`);
    } catch {
      setText(byId("detail-note"), command);
    }
  }
}
