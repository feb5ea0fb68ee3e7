// uPlot charts in the page's colours, drawn anew when those change.

import { colour, onTheme } from "./common.js";
import { brief } from "./monitor-dom.js";

const charts = new Set();
const cache = new Map();

/** A colour of the theme, looked up once. */
export function ink(name) {
  if (!cache.has(name)) cache.set(name, colour(name));
  return cache.get(name);
}

let began = false;
export function watchTheme() {
  onTheme(() => {
    cache.clear();
    if (began) for (const chart of charts) chart.remake();
    began = true;
  });
}

/** The same colour, thinner. */
export const faint = (name, share) => ink(name).replace("rgb(", "rgba(").replace(")", `, ${share})`);

const FONT = "11px system-ui, 'Liberation Sans', sans-serif";

/** A chart in an element, as wide and high as that; `make` gives uPlot's options, `data` its columns. */
export class Chart {
  constructor(place, make) {
    this.place = place;
    this.make = make;
    this.data = null;
    this.plot = null;
    this.shape = "";
    charts.add(this);
    new ResizeObserver(() => this.#fit()).observe(place);
  }

  /** Draw columns; `shape` names what the series are: another shape is another chart. */
  draw(data, shape = "") {
    this.data = data;
    if (this.plot && shape === this.shape) this.plot.setData(data);
    else {
      this.shape = shape;
      this.remake();
    }
  }

  remake() {
    this.plot?.destroy();
    this.plot = null;
    if (!this.data || !this.place.clientWidth) return;
    this.plot = new uPlot({ ...common(), ...this.make(), ...this.#size(0) }, this.data, this.place);
    this.#fit();
  }

  #size(legend) {
    return { width: this.place.clientWidth, height: Math.max(60, this.place.clientHeight - legend) };
  }

  #fit() {
    if (!this.place.clientWidth) return;
    if (!this.plot) return this.remake();
    const legend = this.place.querySelector(".u-legend")?.offsetHeight ?? 0;
    const { width, height } = this.#size(legend);
    if (this.plot.width !== width || this.plot.height !== height) this.plot.setSize({ width, height });
  }

  forget() {
    this.plot?.destroy();
    this.plot = null;
    this.data = null;
  }
}

const common = () => ({
  cursor: { y: false, points: { size: 6 }, drag: { x: false, y: false } },
  legend: { live: true },
  padding: [8, 8, 0, 0],
});

/** An axis in the page's colours. */
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

/** A line in a colour of the theme. */
export function line(label, name, more = {}) {
  return {
    label,
    stroke: ink(name),
    width: 2,
    points: { show: false },
    spanGaps: false,
    value: (_, value) => brief(value),
    ...more,
  };
}

/** Series of the run over time, in minutes before now. */
export class Timeline {
  constructor(place, names) {
    this.names = names;
    this.chart = new Chart(place, () => ({
      scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(1e-9, (high ?? 1) * 1.08)] } },
      axes: [axis({ size: 22, values: (_, ticks) => ticks.map(ago), space: 60 }), axis()],
      series: [
        { label: "", value: (_, value) => (value === null ? "" : ago(value)) },
        ...names.map(({ label, ink: name, dash }) => line(label, name, { dash: dash ?? [], value: (_, value) => brief(value) })),
      ],
    }));
  }

  draw(series) {
    const last = series.t.at(-1) ?? 0;
    if (series.t.length < 2) return;
    this.chart.draw([series.t.map((t) => (t - last) / 60), ...this.names.map(({ name }) => series[name])]);
  }
}

function ago(minutes) {
  const seconds = Math.round(-minutes * 60);
  if (!seconds) return "now";
  return seconds % 60 ? `−${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}` : `−${seconds / 60} min`;
}
