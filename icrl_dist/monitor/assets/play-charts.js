// The gauge of the OOD score and the chart of returns.

import { canvas, color, number } from "/assets/common.js";

const LOWEST = -1;
const HIGHEST = 4;

/** Draw the OOD score `value` (null if unknown) on a scale with marks at 0 and 1. */
export function drawGauge(element, value) {
  const { pen, width, height } = canvas(element);
  const place = (v) => ((Math.min(Math.max(v, LOWEST), HIGHEST) - LOWEST) / (HIGHEST - LOWEST)) * (width - 12) + 6;
  pen.fillStyle = color("--raised");
  pen.fillRect(6, 4, width - 12, 12);
  if (value !== null) {
    pen.fillStyle = color(value < 1 ? "--ok" : "--bad");
    pen.fillRect(6, 4, place(value) - 6, 12);
  }
  pen.strokeStyle = color("--text");
  pen.fillStyle = color("--muted");
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  for (let v = LOWEST; v <= HIGHEST; v++) {
    pen.fillText(String(v), place(v), height - 3);
    if (v === 0 || v === 1) pen.strokeRect(place(v), 2, 0.5, 16);
  }
}

const HEIGHT = 210;

/** A chart of returns and expected optimal returns by episode. */
export class ReturnChart {
  constructor(element) {
    this.element = element;
    this.plot = null;
  }

  /** Create the chart in the colors of the present theme. */
  remake() {
    const axis = () => ({
      stroke: color("--muted"),
      grid: { stroke: color("--line"), width: 1 },
      ticks: { stroke: color("--line"), width: 1 },
      font: "12px system-ui, sans-serif",
    });
    this.plot?.destroy();
    this.plot = new uPlot(
      {
        width: this.element.clientWidth,
        height: HEIGHT,
        legend: { show: true, live: true },
        cursor: { drag: { x: false, y: false } },
        scales: { x: { time: false, range: (_, low, high) => [Math.max(0, low - 0.5), Math.max(10.5, high + 0.5)] }, y: { range: [0, 100] } },
        axes: [
          { ...axis(), incrs: [1, 2, 5, 10, 20, 50, 100], size: 34 },
          { ...axis(), size: 40 },
        ],
        series: [
          { label: "episode" },
          { label: "return", stroke: color("--series-1"), width: 2, points: { show: true, size: 6, fill: color("--series-1") } },
          { label: "optimum, expected", stroke: color("--series-3"), width: 2, dash: [7, 5], points: { show: false }, spanGaps: false },
        ],
      },
      [[], [], []],
      this.element,
    );
  }

  resize() {
    this.plot?.setSize({ width: this.element.clientWidth, height: HEIGHT });
  }

  draw(numbers, episodes, horizon) {
    if (!this.plot) return;
    this.plot.setScale("y", { min: 0, max: Math.max(10, horizon) });
    this.plot.setData([numbers, episodes.total, episodes.optimum]);
  }
}

/** The rows of the table of returns, newest first. */
export function returnRows(numbers, episodes) {
  const rows = numbers.map((n, i) => {
    const row = document.createElement("tr");
    const optimum = episodes.optimum[i] === null ? "task changed" : number(episodes.optimum[i], 1);
    [n, number(episodes.total[i]), optimum, episodes.overridden[i], episodes.by_hand[i]].forEach((value, column) => {
      const cell = document.createElement("td");
      if (column) cell.className = "number";
      cell.textContent = value;
      row.append(cell);
    });
    return row;
  });
  return rows.reverse();
}
