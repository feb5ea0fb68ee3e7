// Draws episodes on canvases.  `at` is the position in an episode in frames, below `frames(drawing)`.

import { canvas, number } from "./common.js";
import { faint, ink } from "./monitor-charts.js";

const CELLS_PER_S = 10; // Dark Room has no simulated time
const POINTS_PER_S = 30;

export function frames(drawing) {
  if (drawing.kind === "room") return drawing.path.length;
  if (drawing.kind === "sticks") return drawing.frames.length;
  return Math.max(...drawing.paths.map((path) => path.points.length));
}

/** Frames a second; real time for a simulation. */
export function rate(drawing) {
  if (drawing.kind === "room") return CELLS_PER_S;
  return drawing.kind === "sticks" ? 1 / drawing.frame_s : POINTS_PER_S;
}

/** A description of a drawing in text. */
export function description(drawing) {
  if (drawing.kind === "room") {
    const reached = drawing.path.findIndex(([x, y]) => x === drawing.goal[0] && y === drawing.goal[1]);
    const overridden = drawing.overridden.filter(Boolean).length;
    const found = reached < 0 ? "goal never reached" : `goal reached after ${number(reached)} steps`;
    return `Dark Room, ${drawing.size} by ${drawing.size}: ${found}, ${overridden} of ${drawing.overridden.length} actions overridden`;
  }
  if (drawing.kind === "sticks") {
    const force = drawing.force.length ? drawing.force.reduce((sum, each) => sum + each, 0) / drawing.force.length : 0;
    return `Stick figure, ${drawing.frames.length} frames; mean force ${number(100 * force)}% of the largest`;
  }
  return `From above: ${drawing.paths.map((path) => path.name).join(" and ")}, ${frames(drawing)} frames`;
}

/** Draw the episode up to frame `at`, or all of it if `still`. */
export function draw(element, drawing, at, still = false) {
  const { pen: ctx, width, height } = canvas(element);
  if (!width) return;
  ctx.lineCap = ctx.lineJoin = "round";
  const moment = Math.min(frames(drawing) - 1, Math.max(0, at));
  if (drawing.kind === "room") room(ctx, width, height, drawing, still ? frames(drawing) - 1 : moment);
  else if (drawing.kind === "sticks") sticks(ctx, width, height, drawing, Math.floor(moment));
  else paths(ctx, width, height, drawing, still ? frames(drawing) - 1 : Math.floor(moment));
}

function room(ctx, width, height, drawing, at) {
  const side = Math.min(width, height) - 2;
  const cell = side / drawing.size;
  const [left, top] = [(width - side) / 2, (height - side) / 2];
  const place = ([x, y]) => [left + (x + 0.5) * cell, top + side - (y + 0.5) * cell];
  if (cell >= 4) grid(ctx, left, top, side, drawing.size);
  const [gx, gy] = place(drawing.goal);
  ctx.fillStyle = faint("--ok", 0.28);
  ctx.fillRect(gx - cell / 2, gy - cell / 2, cell, cell);
  ctx.strokeStyle = ink("--ok");
  ctx.lineWidth = 2;
  ctx.strokeRect(gx - cell / 2 + 1, gy - cell / 2 + 1, cell - 2, cell - 2);
  const whole = Math.floor(at);
  for (let step = 1; step <= whole; step += 1) {
    const age = whole - step;
    ctx.globalAlpha = Math.max(0.3, 1 - age / 14);
    const overridden = drawing.overridden[step - 1];
    stroke(ctx, [place(drawing.path[step - 1]), place(drawing.path[step])], overridden ? "--series-2" : "--series-1", overridden ? 3 : 2);
    if (overridden) cross(ctx, place(drawing.path[step - 1]), Math.min(4, cell / 4));
  }
  ctx.globalAlpha = 1;
  const [from, to] = [place(drawing.path[whole]), place(drawing.path[Math.min(whole + 1, drawing.path.length - 1)])];
  const part = at - whole;
  ctx.fillStyle = ink("--text");
  dot(ctx, from[0] + (to[0] - from[0]) * part, from[1] + (to[1] - from[1]) * part, Math.max(2, Math.min(5, cell * 0.28)));
}

function grid(ctx, left, top, side, size) {
  ctx.strokeStyle = ink("--line");
  ctx.lineWidth = 1;
  ctx.beginPath();
  for (let line = 0; line <= size; line += 1) {
    const offset = (side * line) / size;
    ctx.moveTo(left + offset, top);
    ctx.lineTo(left + offset, top + side);
    ctx.moveTo(left, top + offset);
    ctx.lineTo(left + side, top + offset);
  }
  ctx.stroke();
}

function stroke(ctx, points, name, width) {
  ctx.strokeStyle = ink(name);
  ctx.lineWidth = width;
  ctx.beginPath();
  points.forEach(([x, y], index) => (index ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.stroke();
}

function cross(ctx, [x, y], reach) {
  stroke(ctx, [[x - reach, y - reach], [x + reach, y + reach]], "--series-2", 1.5);
  stroke(ctx, [[x - reach, y + reach], [x + reach, y - reach]], "--series-2", 1.5);
}

function dot(ctx, x, y, radius) {
  ctx.beginPath();
  ctx.arc(x, y, radius, 0, 2 * Math.PI);
  ctx.fill();
}

const boundsOf = new WeakMap();

/** The bounding box of all points of a drawing, cached. */
function bounds(drawing, points) {
  if (!boundsOf.has(drawing)) {
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [x, y] of points()) {
      box[0] = Math.min(box[0], x);
      box[1] = Math.min(box[1], y);
      box[2] = Math.max(box[2], x);
      box[3] = Math.max(box[3], y);
    }
    boundsOf.set(drawing, box.every(Number.isFinite) ? box : [0, 0, 1, 1]);
  }
  return boundsOf.get(drawing);
}

/** A map from meters to the canvas, with one scale for both axes and y upwards. */
function fit(width, height, [x0, y0, x1, y1]) {
  const scale = Math.min((width - 12) / Math.max(1e-6, x1 - x0), (height - 20) / Math.max(1e-6, y1 - y0));
  const [cx, cy] = [(x0 + x1) / 2, (y0 + y1) / 2];
  return ([x, y]) => [width / 2 + (x - cx) * scale, (height - 8) / 2 - (y - cy) * scale];
}

function sticks(ctx, width, height, drawing, at) {
  const ends = function* () {
    for (const frame of drawing.frames) for (const [x0, y0, x1, y1] of frame) yield* [[x0, y0], [x1, y1]];
  };
  const place = fit(width, height, bounds(drawing, ends));
  for (const back of [4, 2, 0]) {
    if (at - back < 0) continue;
    ctx.globalAlpha = back ? 0.16 : 1;
    for (const [x0, y0, x1, y1] of drawing.frames[at - back]) stroke(ctx, [place([x0, y0]), place([x1, y1])], "--series-1", back ? 2 : 3);
  }
  ctx.globalAlpha = 1;
  const force = drawing.force[Math.min(at, drawing.force.length - 1)] ?? 0;
  ctx.fillStyle = ink("--raised");
  ctx.fillRect(2, height - 5, width - 4, 4);
  ctx.fillStyle = ink("--series-2");
  ctx.fillRect(2, height - 5, (width - 4) * force, 4);
}

const PATHS = [["--series-1", []], ["--series-2", [4, 3]], ["--series-3", [1, 3]]];

function paths(ctx, width, height, drawing, at) {
  const points = function* () {
    for (const path of drawing.paths) yield* path.points;
    yield drawing.goal;
  };
  const place = fit(width, height, bounds(drawing, points));
  const [gx, gy] = place(drawing.goal);
  ctx.strokeStyle = ink("--ok");
  ctx.lineWidth = 2;
  ctx.strokeRect(gx - 5, gy - 5, 10, 10);
  drawing.paths.forEach((path, index) => {
    const [name, dash] = PATHS[index % PATHS.length];
    ctx.setLineDash(dash);
    stroke(ctx, path.points.slice(0, at + 1).map(place), name, 2);
    ctx.setLineDash([]);
    const [x, y] = place(path.points[Math.min(at, path.points.length - 1)]);
    ctx.fillStyle = ink(name);
    dot(ctx, x, y, 3.5);
  });
}
