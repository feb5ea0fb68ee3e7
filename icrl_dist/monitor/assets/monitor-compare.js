// Two runs in one chart: their training returns, and their held-out returns.

import { newestCurve } from "./monitor-adaptation.js";
import { Chart, axis, line } from "./monitor-charts.js";
import { brief, byId, el, setText } from "./monitor-dom.js";
import { VERDICTS, interval, percent } from "./monitor-heldout.js";

const INKS = ["--series-1", "--series-2"];

export class Comparison {
  constructor() {
    this.lines = [];
    this.charts = ["compare-training", "compare-heldout"].map((id, index) => new Chart(byId(id), () => options(this.lines[index])));
  }

  hide() {
    byId("comparison").hidden = true;
    document.body.classList.remove("comparing");
  }

  /** `stores`: of the run that is shown and of the other; `names`: theirs; `notes`: why one has nothing to show. */
  draw(stores, names, notes) {
    byId("comparison").hidden = false;
    document.body.classList.add("comparing");
    setText(byId("compare-names"), names.join(" and "));
    setText(byId("compare-notes"), [...new Set(notes.filter(Boolean))].join(" "));
    this.#training(stores, names);
    this.#heldOut(stores, names);
  }

  #training(stores, names) {
    const scaled = stores.every((store) => newestCurve(store)?.scaled);
    const curves = stores.map((store) => newestCurve(store, scaled));
    setText(byId("compare-unit"), scaled ? "mean return over the optimal return" : "mean return");
    const lines = curves.flatMap((curve, index) =>
      curve?.means.length ? [{ label: `${names[index]} (${curve.name})`, ink: INKS[index], width: 2.5, dash: [], begin: curve.begin, values: curve.means }] : [],
    );
    this.#plot(0, lines);
    const texts = curves.map((curve, index) => `${names[index]}: ${curve?.means.length ? `n = ${curve.variations} of ${curve.started} variations` : curve ? "no mean until every optimum is computed" : "no episode yet"}`);
    setText(byId("compare-training-note"), `${texts.join("; ")}. Training tasks and adversaries, which may differ between the runs.`);
  }

  #heldOut(stores, names) {
    const levels = stores.map(({ evaluation }) => evaluation?.levels ?? []);
    const common = levels[0].map(({ p }) => p).filter((p) => levels[1].some((level) => level.p === p));
    const p = common.length ? Math.max(...common) : null;
    const chosen = levels.map((all) => all.find((level) => level.p === p) ?? all.reduce((best, level) => (best && best.p > level.p ? best : level), null));
    const lines = chosen.flatMap((level, index) =>
      ["model", "newest"].flatMap((role) =>
        (level?.agents ?? [])
          .filter((agent) => agent.role === role && (role === "newest" || agent.key === "t0"))
          .map((agent) => ({ label: `${names[index]}: ${agent.name}`, ink: INKS[index], width: role === "newest" ? 2.5 : 1.5, dash: role === "newest" ? [] : [7, 4], begin: 0, values: agent.episodes })),
      ),
    );
    this.#plot(1, lines);
    const strengths = chosen.map((level) => (level ? `p = ${brief(level.p)}` : ""));
    const same = p !== null || strengths.some((text) => !text);
    setText(byId("compare-p"), same ? (strengths.find(Boolean) ?? "") : "different strengths p");
    const cells = [
      ["Method, problem", ...stores.map(({ run }) => [run.method?.toUpperCase().replaceAll("_", "-"), run.problem].filter(Boolean).join(", ") || "–")],
      ["State", ...stores.map(({ run, replay }) => (replay?.loading ? "loading" : (run.state ?? "–")))],
      ...(same ? [] : [["Strength", ...strengths]]),
      ["Newest model", ...chosen.map((level) => agentText(level, (agent) => agent.role === "newest"))],
      ["T^0", ...chosen.map((level) => agentText(level, (agent) => agent.key === "t0"))],
      ["Newest less T^0", ...chosen.map((level) => (level?.verdict ? `${interval(level.gain, brief)}: ${VERDICTS[level.verdict]}` : "–"))],
      ["Random", ...chosen.map((level) => agentText(level, (agent) => agent.key === "random"))],
      ["Evaluation", ...stores.map(({ evaluation }) => (evaluation ? `last ${evaluation.last} episodes, ${evaluation.tasks} tasks, ${evaluation.evaluations} each` : "no held-out returns yet"))],
    ];
    const text = JSON.stringify([names, cells]);
    if (this.cells === text) return;
    this.cells = text;
    const head = el("tr", {}, el("td"), ...names.map((name, index) => heading(name, INKS[index])));
    const rows = cells.map(([title, ...values]) => el("tr", {}, el("th", { scope: "row" }, title), ...values.map((value) => el("td", {}, value))));
    byId("compare-table").replaceChildren(el("table", {}, el("thead", {}, head), el("tbody", {}, ...rows)));
  }

  /** Draw lines over episodes; one without a value is left out. */
  #plot(index, lines) {
    this.lines[index] = lines;
    const chart = this.charts[index];
    if (!lines.length) return chart.clear();
    const longest = Math.max(...lines.map(({ begin, values }) => begin + values.length));
    const x = Array.from({ length: longest }, (_, episode) => episode + 1);
    chart.draw([x, ...lines.map(({ begin, values }) => x.map((episode) => values[episode - 1 - begin] ?? null))], JSON.stringify(lines.map(({ label }) => label)));
  }
}

function heading(name, ink) {
  const swatch = el("span", { class: "swatch" });
  swatch.style.color = `var(${ink})`;
  return el("th", { scope: "col", title: name }, el("span", { class: "key" }, swatch, name));
}

function agentText(level, wanted) {
  const agent = level?.agents.find(wanted);
  if (!agent) return "–";
  const share = agent.share ? `, ${interval(agent.share, percent)} of ${level.ceiling}` : "";
  const value = agent.share ? brief(agent.value[0]) : interval(agent.value, brief);
  return `${agent.name === "random" ? "" : `${agent.name}: `}${value}${share}`;
}

function options(lines) {
  return {
    scales: { x: { time: false, range: (_, low, high) => [low, Math.max(high, low + 1)] }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), (high ?? 1) * 1.06 || 1] } },
    axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis()],
    series: [{ label: "episode" }, ...lines.map(({ label, ink, width, dash, values }) => line(label, ink, { width, dash, points: { show: values.length < 2, size: 6 } }))],
  };
}
