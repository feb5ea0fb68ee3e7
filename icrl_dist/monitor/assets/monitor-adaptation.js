// The chart of returns by episode: the mean over variations for each phase, and single variations.

import { Chart, axis, faint, ink, line } from "./monitor-charts.js";
import { brief, byId, mean, plural, setText } from "./monitor-dom.js";
import { later } from "./monitor-store.js";

const MAX_DRAWN = 200; // limit on the variations that are drawn and that the quantiles are computed from
const MAX_PHASES = 3;
const MAX_EPISODES = 1000; // limit on the episodes on the axis
const INKS = ["--series-1", "--series-6", "--series-6"];
const DASHES = [[], [7, 4], [2, 3]];

let chart = null;
let shown = { rows: [], newest: "", scaled: true, x: [] };

/** The divisor of a phase's returns: its optimum (null if unknown) if any row has one, else 1. */
export function scaling(rows) {
  const scaled = rows.some((row) => row.phases.some((phase) => phase.optimum > 0));
  return { scaled, scale: (phase) => (scaled ? (phase.optimum > 0 ? phase.optimum : null) : 1) };
}

/** A row's phase with this name, if it has returns and a divisor. */
const drawable = (row, name, scale) => row.phases.find((phase) => phase.name === name && phase.trials.length && scale(phase) !== null);

export function drawAdaptation(rows) {
  const { scaled, scale } = scaling(rows);
  const phases = [...new Set(rows.flatMap((row) => row.phases.filter((phase) => drawable(row, phase.name, scale)).map((phase) => phase.name)))];
  phases.sort((one, other) => (one === other ? 0 : later(one, other) === one ? -1 : 1)).splice(MAX_PHASES);
  const newest = phases[0];
  setText(byId("adaptation-unit"), `${scaled ? "return over the optimal return" : "return"}, by episode`);
  if (!newest) return;
  const started = rows.filter((row) => row.phases.some((phase) => phase.name === newest && phase.trials.length));
  const known = started.filter((row) => drawable(row, newest, scale));
  const columns = phases.map((name) => means(rows, name, scale));
  const trials = ordered(columns[0]).slice(-MAX_EPISODES);
  const x = trials.map((trial) => trial + 1);
  const [low, high] = spread(known, newest, scale, trials);
  shown = { rows: sample(known), newest, scale, x };
  chart ??= new Chart(byId("adaptation"), options);
  shown.phases = phases;
  const lines = columns.map((column) => trials.map((trial) => column.get(trial) ?? null));
  chart.draw([x, high, low, ...lines.toReversed()], [scaled, x.length < 2, ...phases].join());
  describe(columns, phases, known.length, started.length, scaled);
}

/** Mean over variations by trial; trials need not be consecutive. */
function means(rows, name, scale) {
  const sums = new Map();
  for (const row of rows) {
    const phase = drawable(row, name, scale);
    phase?.trials.forEach((trial, index) => {
      const [sum, count] = sums.get(trial) ?? [0, 0];
      sums.set(trial, [sum + phase.returns[index] / scale(phase), count + 1]);
    });
  }
  return new Map(Array.from(sums, ([trial, [sum, count]]) => [trial, sum / count]));
}

const ordered = (column) => [...column.keys()].sort((one, other) => one - other);

function sample(rows) {
  const every = Math.ceil(rows.length / MAX_DRAWN);
  return rows.filter((_, index) => index % every === 0);
}

/** Tenth and ninetieth percentile over variations, by episode. */
function spread(rows, name, scale, trials) {
  const values = new Map(trials.map((trial) => [trial, []]));
  for (const row of sample(rows)) {
    const phase = drawable(row, name, scale);
    phase?.trials.forEach((trial, index) => values.get(trial)?.push(phase.returns[index] / scale(phase)));
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
  return {
    scales: { x: { time: false, range: (_, low, high) => [low, Math.max(high, low + 1)] }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(high ?? 1, 0.1) * 1.04] } },
    axes: [axis({ size: 22, incrs: [1, 2, 5, 10, 20, 50, 100] }), axis()],
    series: [{ label: "episode" }, edge("90%"), edge("10%"), ...lines.toReversed()],
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
      if (index) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
    });
    ctx.stroke();
  }
  ctx.restore();
}

function describe(columns, phases, known, all, scaled) {
  const [newest, ...earlier] = columns.map((column) => ordered(column).map((trial) => column.get(trial)));
  const ends = earlier.map((values, index) => `${phases[index + 1]} ended at ${brief(mean(values.slice(-5)))}`);
  const left = known < all && scaled ? ` (${plural(all - known, "optimum")} not computed yet)`.replace("optimums", "optima") : "";
  setText(
    byId("adaptation-summary"),
    `${phases[0]}: ${brief(newest[0])} in the first episode, ${brief(mean(newest.slice(-5)))} in the last five, ` +
      `mean of ${plural(known, "variation")}${left}${ends.length ? "; " + ends.join(", ") : ""}. Shaded: 10% to 90% of variations.`,
  );
}
