// uPlot charts in the colors of the theme; a change of the theme draws them again.

import { color, onTheme } from "./common.js";
import { brief, el, setText } from "./monitor-dom.js";

const charts = new Set();
const cache = new Map();

/** A color of the theme, cached. */
export function ink(name) {
  if (!cache.has(name)) cache.set(name, color(name));
  return cache.get(name);
}

let started = false;
export function watchTheme() {
  onTheme(() => {
    cache.clear();
    if (started) for (const chart of charts) chart.remake();
    started = true;
  });
}

/** A color of the theme with opacity `share`. */
export const faint = (name, share) => ink(name).replace("rgb(", "rgba(").replace(")", `, ${share})`);

const FONT = "11px system-ui, 'Liberation Sans', sans-serif";

/** A chart that fills an element, with a legend above; `make` returns uPlot's options. */
export class Chart {
  constructor(place, make) {
    this.keys = el("div", { class: "keys small", "aria-hidden": "true" });
    this.place = el("div", { class: "plot" });
    place.append(this.keys, this.place);
    this.make = make;
    this.data = null;
    this.plot = null;
    this.shape = "";
    charts.add(this);
    new ResizeObserver(() => this.#fit()).observe(this.place);
  }

  /** Draw columns; `shape` identifies the series, and another shape makes a new chart. */
  draw(data, shape = "") {
    this.data = data;
    if (this.plot && shape === this.shape) this.plot.setData(data);
    else {
      this.shape = shape;
      this.remake();
    }
    this.#updateLegend();
  }

  remake() {
    this.plot?.destroy();
    this.plot = null;
    if (!this.data || !this.place.clientWidth) return;
    const made = this.make();
    const hooks = { ...made.hooks, setCursor: [() => this.#updateLegend()] };
    this.plot = new uPlot({ ...common(), ...made, hooks, ...this.#size() }, this.data, this.place);
    this.values = [];
    this.keys.replaceChildren(
      ...made.series.flatMap((series, index) => {
        if (series.quiet) return [];
        const value = el("b");
        this.values.push([index, value]);
        const kind = !series.dash?.length ? "" : series.dash[0] < 4 ? " dotted" : " dashed";
        const swatch = el("span", { class: `swatch${kind}` });
        swatch.style.color = series.stroke ?? "transparent";
        return el("span", { class: "key" }, ...(index ? [swatch] : []), `${series.label} `, value);
      }),
    );
    this.#updateLegend();
  }

  /** Show in the legend the values under the cursor, else the newest values. */
  #updateLegend() {
    if (!this.plot?.data) return;
    const { idx } = this.plot.cursor;
    for (const [index, element] of this.values ?? []) {
      const column = this.plot.data[index];
      const value = idx === null || idx === undefined ? (index ? column.findLast((each) => each !== null) : column.at(-1)) : column[idx];
      const { format } = this.plot.series[index];
      setText(element, (format ?? brief)(value));
    }
  }

  #size() {
    return { width: this.place.clientWidth, height: Math.max(50, this.place.clientHeight) };
  }

  #fit() {
    if (!this.place.clientWidth) return;
    if (!this.plot) return this.remake();
    const { width, height } = this.#size();
    if (this.plot.width !== width || this.plot.height !== height) this.plot.setSize({ width, height });
  }

  clear() {
    this.plot?.destroy();
    this.plot = null;
    this.data = null;
    this.keys.replaceChildren();
  }
}

const common = () => ({
  cursor: { y: false, points: { size: 6 }, drag: { x: false, y: false } },
  legend: { show: false },
  padding: [8, 14, 0, 0],
});

/** An axis in the colors of the theme. */
export function axis(more = {}) {
  return {
    stroke: ink("--muted"),
    font: FONT,
    size: 40,
    gap: 4,
    grid: { stroke: ink("--line"), width: 1 },
    ticks: { show: false },
    values: (_, values) => values.map((value) => (value === null ? "" : brief(value))),
    ...more,
  };
}

/** A line in a color of the theme. */
export function line(label, name, more = {}) {
  return {
    label,
    stroke: ink(name),
    width: 2,
    points: { show: false },
    spanGaps: false,
    ...more,
  };
}

const MINUTES = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720, 1440, 2880, 10080, 43200, 525600];

/** Series of the run over time, in minutes before now. */
export class Timeline {
  constructor(place, names, least = 1) {
    this.names = names;
    this.chart = new Chart(place, () => ({
      scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(least, (high ?? 1) * 1.08)] } },
      axes: [axis({ size: 22, values: (_, ticks) => ticks.map(ago), space: 60, incrs: MINUTES }), axis()],
      series: [
        { label: "", format: (value) => (value === undefined ? "" : ago(value)) },
        ...names.map(({ label, ink: name, dash, points }) => line(label, name, { dash: dash ?? [], points: { show: points ?? false, size: 4 } })),
      ],
    }));
  }

  /** `history`: means of what is older than the series. */
  draw(series, history) {
    const last = series.t.at(-1) ?? 0;
    if (series.t.length < 2) return;
    const older = history.t.filter((t) => t < series.t[0]).length;
    const join = (name) => [...(history[name] ?? []).slice(0, older), ...series[name]];
    this.chart.draw([join("t").map((t) => (t - last) / 60), ...this.names.map(({ name }) => join(name))]);
  }
}

function ago(minutes) {
  const seconds = Math.round(-minutes * 60);
  if (!seconds) return "now";
  if (seconds >= 5400) return `−${brief(seconds / 3600)} h`;
  return seconds % 60 ? `−${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}` : `−${seconds / 60} min`;
}
