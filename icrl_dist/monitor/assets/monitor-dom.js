// Elements, texts and numbers.  Data from messages becomes text, never markup.

import { number } from "./common.js";

export const byId = (id) => document.getElementById(id);

/** An element with attributes and children; a child that is not a node becomes text. */
export function el(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

/** Set an element's text only if it differs, so that screen readers and selections are not disturbed. */
export function setText(element, text) {
  const newText = String(text);
  if (element.textContent !== newText) element.textContent = newText;
}

/** Style of the badge of a run's or worker's state; the badge also contains the state as text. */
const KINDS = {
  collecting: "ok", fitting: "ok", training: "ok", evaluating: "ok", finished: "ok", working: "ok", done: "ok",
  waiting: "muted", starting: "muted", silent: "warn", interrupted: "warn", failed: "bad", gone: "bad",
};

export function badge(element, state, alerts = 0) {
  const kind = `badge ${alerts ? "bad" : (KINDS[state] ?? "muted")}`;
  if (element.className !== kind) element.className = kind;
  setText(element, alerts ? `${state}, ${plural(alerts, "alert")}` : state);
}

/** A duration in seconds as 1:02:03 or 2:03; a dash for null. */
export function span(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.round(seconds);
  const [hours, minutes, rest] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const two = (value) => String(value).padStart(2, "0");
  if (hours >= 48) return `${number(hours / 24, 1)} days`;
  return hours ? `${hours}:${two(minutes)}:${two(rest)}` : `${minutes}:${two(rest)}`;
}

/** A time in Unix seconds as the time of day; a dash for 0, an unknown time. */
export const clock = (time) => (time && Math.abs(time) < 8e12 ? new Date(time * 1000).toLocaleTimeString("en-GB") : "–");

/** A number with about three digits; a dash for null. */
export function brief(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e9)) return value.toExponential(2);
  return number(value, size >= 100 || Number.isInteger(value) ? 0 : size >= 10 ? 1 : 2);
}

const parameter = (value) =>
  Array.isArray(value) ? `[${value.map(brief).join(", ")}]` : typeof value === "number" ? brief(value) : String(value);

/** Parameters as text: "p 0.31, alpha [1.2, 0.4]". */
export const parameters = (named, without = []) =>
  Object.entries(named)
    .filter(([name]) => !without.includes(name))
    .map(([name, value]) => `${name} ${parameter(value)}`)
    .join(", ");

/** Counts by reason as text. */
export const reasons = (counts) =>
  Object.entries(counts ?? {}).map(([name, count]) => `${name} ${number(count)}`).join(", ") || "none";

export const plural = (count, noun) => `${number(count)} ${noun}${count === 1 ? "" : "s"}`;

export const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** The different trials in order, with one more after each gap, at which nothing has a value, so that no line crosses it. */
export function withGaps(trials) {
  const all = [...new Set(trials)].sort((one, other) => one - other);
  return all.flatMap((trial, index) => (index + 1 < all.length && all[index + 1] > trial + 1 ? [trial, trial + 1] : [trial]));
}

/** A line over values by trial as an SVG, between `low` and `high`; a missing trial is a gap. */
export function sparkline(svg, trials, values, low, high) {
  const [width, height] = [110, 22];
  const [first, last] = [trials[0] ?? 0, trials.at(-1) ?? 0];
  const place = (value, index) => {
    const x = last > first ? 2 + ((width - 4) * (trials[index] - first)) / (last - first) : width / 2;
    const y = height - 3 - ((height - 6) * (value - low)) / (high - low || 1);
    return `${x.toFixed(1)} ${y.toFixed(1)}`;
  };
  const places = values.map(place);
  const steps = places.map((at, index) => `${index && trials[index] === trials[index - 1] + 1 ? "L" : "M"}${at}`);
  svg.firstChild.setAttribute("d", steps.join("") || "M0 0");
  const [x, y] = (places.at(-1) ?? "-9 -9").split(" ");
  svg.lastChild.setAttribute("cx", x);
  svg.lastChild.setAttribute("cy", y);
}

export function sparklineElement() {
  const make = (tag, attributes) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };
  const svg = make("svg", { class: "spark", viewBox: "0 0 110 22", "aria-hidden": "true" });
  svg.append(make("path", {}), make("circle", { r: "2" }));
  return svg;
}
