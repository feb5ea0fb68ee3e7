// The chart of returns by episode: the mean over variations for each phase, and single variations.

import { Chart, axis, faint, ink, line } from "./monitor-charts.js";
import { brief, byId, mean, plural, setText, withGaps } from "./monitor-dom.js";
import { later } from "./monitor-store.js";

const MAX_DRAWN = 200; // limit on the variations that are drawn and that the quantiles are computed from
const MAX_PHASES = 3;
const MAX_EPISODES = 1000; // limit on the episodes on the axis
const KEPT = 256; // returns that a row has of one phase at most, the newest
const INKS = ["--series-1", "--series-6", "--series-6"];
const DASHES = [[], [7, 4], [2, 3]];
const REFERENCE_INKS = ["--series-2", "--series-3", "--series-4"];

let chart = null;
let shown = { rows: [], newest: "", x: [], phases: [], references: [] };

/** The divisor of a phase's returns: its optimum (null if unknown) if any row has one, else 1. */
export function scaling(rows) {
  const scaled = rows.some((row) => row.phases.some((phase) => phase.optimum > 0));
  return { scaled, scale: (phase) => (scaled ? (phase.optimum > 0 ? phase.optimum : null) : 1) };
}

/** A row's phase with this name, if it has returns and a divisor. */
const drawable = (row, name, scale) => row.phases.find((phase) => phase.name === name && phase.trials.length && scale(phase) !== null);

/**
 * The mean return by episode of a run's newest phase with returns, or null; `scaled`: whether to divide by the optimum, by
 * default if one is known.  `variations`: number in the mean, `started`: number with returns.
 */
export function newestCurve(store, scaled = null) {
  const rows = [...store.variations.values()];
  const found = scaling(rows);
  const scale = scaled === false ? () => 1 : found.scale;
  const names = rows.flatMap((row) => row.phases.filter((phase) => drawable(row, phase.name, scale)).map((phase) => phase.name));
  if (!names.length) return null;
  const name = names.reduce(later);
  const { run } = store;
  const started = rows.filter((row) => row.phases.some((phase) => phase.name === name && phase.trials.length)).length;
  const { begin, means, rows: used } = common(rows, name, scale, run.stage === "collect" && name === `${run.phase}/${run.round}`);
  return { name, begin, means, scaled: found.scaled, variations: used.length, started };
}

/** Draw the training returns of rows; `store`: for what is known of the run beside them. */
export function drawAdaptation(rows, store) {
  const { scaled, scale } = scaling(rows);
  const phases = [...new Set(rows.flatMap((row) => row.phases.filter((phase) => drawable(row, phase.name, scale)).map((phase) => phase.name)))];
  phases.sort((one, other) => (one === other ? 0 : later(one, other) === one ? -1 : 1)).splice(MAX_PHASES);
  setText(byId("adaptation-unit"), `${scaled ? "return over the optimal return" : "return"}, by episode; training adversaries`);
  if (!phases.length) return clear(rows.length ? "No return with a known optimum yet." : store.variations.size ? "No variation matches the filters." : "No episode yet.");
  const { run } = store;
  const open = run.stage === "collect" ? `${run.phase}/${run.round}` : ""; // the phase whose returns are arriving
  const found = phases.map((name) => common(rows, name, scale, name === open));
  const newest = phases[0];
  const started = rows.filter((row) => row.phases.some((phase) => phase.name === newest && phase.trials.length));
  const known = started.filter((row) => drawable(row, newest, scale));
  const drawn = sample(known);
  const trials = found.flatMap((one) => one.means.map((_, index) => one.begin + index));
  const x = withGaps([...trials, ...drawn.flatMap((row) => drawable(row, newest, scale).trials)]).slice(-MAX_EPISODES).map((trial) => trial + 1);
  const lines = found.map((one) => x.map((episode) => one.means[episode - 1 - one.begin] ?? null));
  const [low, high] = spread(found[0].rows, newest, scale, x);
  const top = drawn.map((row) => drawable(row, newest, scale)).reduce((most, phase) => Math.max(most, Math.max(...phase.returns) / scale(phase)), 0);
  shown = { rows: drawn, newest, scale, x, phases, top, references: scaled ? [] : references(store.evaluation) };
  chart ??= new Chart(byId("adaptation"), options);
  const constant = shown.references.map(({ value }) => x.map(() => value));
  const names = shown.references.map(({ label, value }) => `${label} ${value}`);
  chart.draw([x, high, low, ...constant, ...lines.toReversed()], [scaled, x.length < 2, ...phases, ...names].join());
  describe(found, phases, started.length, known.length, scaled, store.past);
}

function clear(text) {
  chart?.clear();
  setText(byId("adaptation-summary"), text);
}

/**
 * The variations with the same episodes, and their mean return by episode; `monitor/averages.py` has the same rule and its
 * reason: unless its returns are arriving (`open`), a phase has no mean until every optimum is computed.  `begin` and `last`: the first and the last trial in the mean.
 */
function common(rows, name, scale, open) {
  const one = (row) => drawable(row, name, () => 1);
  const started = rows.filter((row) => one(row) && !(row.quarantine && row.phases.at(-1).name === name));
  const whole = started
    .map((row) => ({ row, trials: one(row).trials, last: one(row).trials.at(-1) }))
    .filter(({ trials, last }) => trials[0] === Math.max(0, last - KEPT + 1) && trials.length === Math.min(last + 1, KEPT))
    .sort((a, b) => b.last - a.last);
  const begin = whole.length ? Math.max(0, whole[0].last - KEPT + 1) : 0;
  const counts = whole.map(({ last }, index) => (last - begin + 1) * (index + 1));
  const number = counts.lastIndexOf(Math.max(...counts)) + 1;
  const last = number ? whole[number - 1].last : begin;
  const complete = open || !started.some((row) => one(row).pending);
  const used = complete ? whole.slice(0, number).map(({ row }) => row).filter((row) => drawable(row, name, scale)) : [];
  const columns = used.map((row) => drawable(row, name, scale)).map((phase) => new Map(phase.trials.map((trial, index) => [trial, phase.returns[index] / scale(phase)])));
  const means = columns.length ? Array.from({ length: last - begin + 1 }, (_, index) => mean(columns.map((column) => column.get(begin + index)))) : [];
  return { begin, last, rows: used, means };
}

/** Held-out returns of the references at the largest p, for problems without an optimum. */
function references(evaluation) {
  if (!evaluation) return [];
  const level = evaluation.levels.reduce((one, other) => (other.p > one.p ? other : one));
  return level.agents.filter((agent) => agent.role === "reference").slice(0, 3).map((agent) => ({ label: `${agent.name}, held-out`, value: agent.value[0] }));
}

function sample(rows) {
  const every = Math.ceil(rows.length / MAX_DRAWN);
  return rows.filter((_, index) => index % every === 0);
}

/** Tenth and ninetieth percentile over these variations, by episode. */
function spread(rows, name, scale, x) {
  const values = new Map(x.map((episode) => [episode - 1, []]));
  for (const row of sample(rows)) {
    const phase = drawable(row, name, scale);
    phase.trials.forEach((trial, index) => values.get(trial)?.push(phase.returns[index] / scale(phase)));
  }
  const quantile = (q) => [...values.values()].map((each) => (each.sort((a, b) => a - b), each.length ? each[Math.round(q * (each.length - 1))] : null));
  return [quantile(0.1), quantile(0.9)];
}

function options() {
  const { phases } = shown;
  const edge = (label) => ({ ...line(label, "--series-1", { width: 0, quiet: true }), stroke: faint("--series-1", 0) });
  const lines = phases.map((name, age) =>
    line(name, INKS[age], { width: age ? 1.5 : 3, dash: DASHES[age], points: { show: age === 0 && shown.x.length < 2, size: 7, fill: ink(INKS[0]) } }),
  );
  const constant = shown.references.map(({ label }, index) => line(label, REFERENCE_INKS[index], { width: 1.5, dash: [2, 3] }));
  return {
    scales: { x: { time: false, range: (_, low, high) => [low, Math.max(high, low + 1)] }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(high ?? 1, shown.top, 0.1) * 1.04] } },
    axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis()],
    series: [{ label: "episode" }, edge("90%"), edge("10%"), ...constant, ...lines.toReversed()],
    bands: [{ series: [1, 2], fill: faint("--series-1", 0.14) }],
    hooks: { drawAxes: [singles] },
  };
}

/** Draw the curve of every variation, faint, behind the mean. */
function singles(plot) {
  const { ctx } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
  ctx.clip();
  ctx.strokeStyle = faint("--series-1", shown.rows.length > 60 ? 0.07 : 0.2);
  ctx.lineWidth = devicePixelRatio;
  for (const row of shown.rows) {
    const phase = drawable(row, shown.newest, shown.scale);
    if (!phase) continue;
    ctx.beginPath();
    phase.trials.forEach((trial, index) => {
      const [x, y] = [plot.valToPos(trial + 1, "x", true), plot.valToPos(phase.returns[index] / shown.scale(phase), "y", true)];
      if (index && trial === phase.trials[index - 1] + 1) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
    });
    ctx.stroke();
  }
  ctx.restore();
}

const PAST = {
  loading: " Earlier episodes are being loaded.",
  missing: " The learner did not send what was before this view: earlier episodes are missing.",
};

function describe(found, phases, started, solved, scaled, past) {
  const earlier = found.slice(1).map(({ means, rows }, index) => ({ name: phases[index + 1], end: brief(means.length ? mean(means.slice(-5)) : null), n: rows.length }));
  const ends = earlier.map(({ name, end }) => `${name} ended at ${end}`);
  const numbers = earlier.length ? ` n = ${earlier.map(({ name, n }) => `${n} in ${name}`).join(", ")}.` : "";
  const waiting = scaled && solved < started ? ` (${plural(started - solved, "optimum")} not computed yet)`.replace("optimums", "optima") : "";
  const [{ means, rows }] = found;
  const text = means.length
    ? `${phases[0]}: ${brief(means[0])} in the first episode, ${brief(mean(means.slice(-5)))} in the last five, mean of ${plural(rows.length, "variation")} ` +
      `in episodes ${found[0].begin + 1} to ${found[0].last + 1} (n = ${rows.length} of ${started})${waiting}`
    : `${phases[0]}: no mean yet (n = 0 of ${started})${waiting}`;
  setText(byId("adaptation-summary"), `${text}${ends.length ? "; " + ends.join(", ") : ""}. Shaded: 10% to 90% of variations.${numbers}${PAST[past] ?? ""}`);
}
