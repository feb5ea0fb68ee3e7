// The card of held-out returns: the newest model, T^0 and references, with their 95% intervals.

import { number } from "./common.js";
import { Chart, axis, line } from "./monitor-charts.js";
import { brief, byId, el, plural, setText } from "./monitor-dom.js";

const INKS = { newest: "--series-1", model: "--series-6", reference: ["--series-3", "--series-2", "--series-4", "--series-5"] };
export const VERDICTS = { higher: "higher than T^0", lower: "lower than T^0", "not shown": "a difference from T^0 is not shown" };

export const percent = (value) => (value === null ? "–" : `${number(100 * value)}%`);

/** A value with its interval, in the form of `format`. */
export function interval(numbers, format) {
  if (!numbers) return "–";
  const [value, low, high] = numbers;
  return low === null ? format(value) : `${format(value)} [${format(low)}, ${format(high)}]`;
}

export class HeldOut {
  constructor() {
    this.evaluation = null;
    this.level = null;
    byId("heldout-p").addEventListener("change", () => this.#show());
  }

  draw({ evaluation, run }) {
    byId("heldout").hidden = !evaluation && run.state !== "evaluating";
    if (!evaluation) return setText(byId("heldout-note"), "The evaluation on held-out tasks is running.");
    if (evaluation === this.evaluation) return;
    this.evaluation = evaluation;
    const select = byId("heldout-p");
    select.replaceChildren(...evaluation.levels.map(({ p }, index) => el("option", { value: index }, `p = ${brief(p)}`)));
    const strongest = evaluation.levels.reduce((best, { p }, index) => (p > evaluation.levels[best].p ? index : best), 0);
    select.value = String(strongest);
    this.#show();
  }

  #show() {
    const { evaluation } = this;
    const level = (this.level = evaluation.levels[Number(byId("heldout-p").value)]);
    const head = ["Agent", `Last ${evaluation.last}`, ...(level.ceiling ? [`Of ${level.ceiling}`] : [])];
    const rows = level.agents.map((agent) =>
      el(
        "tr",
        { class: agent.role },
        el("th", { scope: "row" }, agent.name),
        el("td", { class: "number" }, level.ceiling ? brief(agent.value[0]) : interval(agent.value, brief)),
        ...(level.ceiling ? [el("td", { class: "number" }, interval(agent.share, percent))] : []),
      ),
    );
    const heads = head.map((name, index) => el("th", { scope: "col", class: index ? "number" : null }, name));
    byId("heldout-table").replaceChildren(el("table", {}, el("thead", {}, el("tr", {}, ...heads)), el("tbody", {}, ...rows)));
    const newest = level.agents.find((agent) => agent.role === "newest");
    const verdict = level.verdict ? `${newest.name}: ${VERDICTS[level.verdict]} (difference ${interval(level.gain, brief)}). ` : "";
    const more = level.left_out ? ` ${plural(level.left_out, "further reference")} in the run's report.` : "";
    const beyond = evaluation.trainings === 1 ? "one training: nothing is claimed beyond it" : plural(evaluation.trainings, "training");
    setText(byId("heldout-note"), `${verdict}95% intervals over ${plural(evaluation.tasks, "task")}, ${plural(evaluation.evaluations, "evaluation")} of each; ${beyond}.${more}`);
    byId("heldout-note").title = evaluation.over;
    this.chart ??= new Chart(byId("heldout-chart"), () => this.#options());
    const longest = Math.max(...level.agents.map((agent) => agent.episodes.length));
    const x = Array.from({ length: longest }, (_, index) => index + 1);
    this.chart.draw([x, ...this.#agents().map((agent) => x.map((_, index) => agent.episodes[index] ?? null))], JSON.stringify([level.p, this.#agents().map((agent) => agent.name)]));
  }

  /** The newest model last, so that it is drawn above the others. */
  #agents() {
    return this.level.agents.toSorted((one, other) => (one.role === "newest") - (other.role === "newest"));
  }

  #options() {
    let references = 0;
    const lines = this.#agents().map((agent) => {
      const ink = agent.role === "reference" ? INKS.reference[references++ % INKS.reference.length] : INKS[agent.role];
      const dash = agent.role === "newest" ? [] : agent.role === "model" ? [7, 4] : [2, 3];
      return line(agent.name, ink, { width: agent.role === "newest" ? 3 : 1.5, dash, points: { show: agent.episodes.length < 2, size: 6 } });
    });
    return {
      scales: { x: { time: false, range: (_, low, high) => [low, Math.max(high, low + 1)] }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), (high ?? 1) * 1.06 || 1] } },
      axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis()],
      series: [{ label: "episode" }, ...lines],
    };
  }
}
