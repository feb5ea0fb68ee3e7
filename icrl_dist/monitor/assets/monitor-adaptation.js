// Return over episodes: the mean over variations, phase by phase, and the variations themselves.

import { Chart, axis, faint, ink, line } from "./monitor-charts.js";
import { brief, byId, mean, plural, say } from "./monitor-dom.js";
import { later } from "./monitor-store.js";

const DRAWN = 200; // single variations drawn at most, and used for the quantiles
const PHASES = 3;
const INKS = ["--series-1", "--series-6", "--series-6"];
const DASHES = [[], [7, 4], [2, 3]];

let chart = null;
let shown = { rows: [], newest: "", scaled: true, x: [] };

/** Returns over the optimum where one is known for any of the rows, else as they are. */
export const scaling = (rows) => (rows.some((row) => row.optimum > 0) ? (row) => (row.optimum > 0 ? row.optimum : null) : () => 1);

export function drawAdaptation(rows) {
  const scale = scaling(rows);
  const scaled = rows.some((row) => row.optimum > 0);
  const known = rows.filter((row) => row.phases.length && scale(row) !== null);
  const phases = [...new Set(known.flatMap((row) => row.phases.map((phase) => phase.name)))];
  phases.sort((one, other) => (one === other ? 0 : later(one, other) === one ? -1 : 1)).splice(PHASES);
  const newest = phases[0];
  say(byId("adaptation-unit"), `${scaled ? "return over the optimal return" : "return"}, by episode`);
  if (!newest) return;
  const columns = phases.map((name) => means(known, name, scale));
  const x = columns[0].map((_, index) => index + 1);
  const [low, high] = spread(known, newest, scale, x.length);
  shown = { rows: sample(known), newest, scale, x };
  chart ??= new Chart(byId("adaptation"), options);
  shown.phases = phases;
  const lines = columns.map((column) => x.map((_, index) => column[index] ?? null));
  chart.draw([x, high, low, ...lines.toReversed()], [scaled, x.length < 2, ...phases].join());
  describe(columns, phases, known.length, rows.length, scaled);
}

function means(rows, name, scale) {
  const sums = [];
  for (const row of rows) {
    const phase = row.phases.find((each) => each.name === name);
    phase?.trials.forEach((trial, index) => {
      const cell = (sums[trial] ??= [0, 0]);
      cell[0] += phase.returns[index] / scale(row);
      cell[1] += 1;
    });
  }
  return Array.from(sums, (cell) => (cell ? cell[0] / cell[1] : null));
}

function sample(rows) {
  const every = Math.ceil(rows.length / DRAWN);
  return rows.filter((_, index) => index % every === 0);
}

/** Tenth and ninetieth percentile over variations, by episode. */
function spread(rows, name, scale, length) {
  const values = Array.from({ length }, () => []);
  for (const row of sample(rows)) {
    const phase = row.phases.find((each) => each.name === name);
    phase?.trials.forEach((trial, index) => values[trial].push(phase.returns[index] / scale(row)));
  }
  const quantile = (q) => values.map((of) => (of.sort((a, b) => a - b), of.length ? of[Math.round(q * (of.length - 1))] : null));
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

/** Every variation's own curve, faint, behind the mean. */
function singles(plot) {
  const { ctx } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
  ctx.clip();
  ctx.strokeStyle = faint("--series-1", shown.rows.length > 60 ? 0.07 : 0.2);
  ctx.lineWidth = devicePixelRatio;
  for (const row of shown.rows) {
    const phase = row.phases.find((each) => each.name === shown.newest);
    if (!phase) continue;
    ctx.beginPath();
    phase.trials.forEach((trial, index) => {
      const [x, y] = [plot.valToPos(trial + 1, "x", true), plot.valToPos(phase.returns[index] / shown.scale(row), "y", true)];
      if (index) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
    });
    ctx.stroke();
  }
  ctx.restore();
}

function describe(columns, phases, known, all, scaled) {
  const [newest, ...earlier] = columns.map((column) => column.filter((value) => value !== null));
  const ends = earlier.map((values, index) => `${phases[index + 1]} ended at ${brief(mean(values.slice(-5)))}`);
  const left = known < all && scaled ? ` (${plural(all - known, "optimum")} not known yet)`.replace("optimums", "optima") : "";
  say(
    byId("adaptation-summary"),
    `${phases[0]}: ${brief(newest[0])} in the first episode, ${brief(mean(newest.slice(-5)))} in the last five, ` +
      `mean of ${plural(known, "variation")}${left}${ends.length ? "; " + ends.join(", ") : ""}. Shaded: 10% to 90% of variations.`,
  );
}
