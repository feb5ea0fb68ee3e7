// Draws episodes on canvases.  `at` is the position in an episode in frames, below `frames(drawing)`.

import { canvas, number } from "./common.js";
import { faint, ink } from "./monitor-charts.js";

const CELLS_PER_S = 10; // Dark Room has no simulated time
const POINTS_PER_S = 30;

export function frames(drawing) {
  if (drawing.kind === "room") return drawing.path.length;
  if (drawing.kind === "sticks") return drawing.frames.length;
  if (drawing.kind === "arm") return drawing.hand.length;
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
    return `Dark Room, ${drawing.size} by ${drawing.size}: ${found}, ${overridden} of ${drawing.overridden.length} steps disturbed`;
  }
  if (drawing.kind === "sticks") {
    const force = drawing.force.length ? drawing.force.reduce((sum, each) => sum + each, 0) / drawing.force.length : 0;
    const travel = drawing.travel?.length ? `, ${number(drawing.travel.at(-1), 1)} m forward` : "";
    return `Stick figure, ${drawing.frames.length} frames${travel}; mean force ${number(100 * force)}% of the largest`;
  }
  if (drawing.kind === "arm") {
    const apart = Math.hypot(...drawing.goal.map((value, axis) => value - drawing.object.at(-1)[axis]));
    return `Arm from the side, ${drawing.hand.length} frames; at the end the object is ${number(100 * apart)} cm from its goal`;
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
  else if (drawing.kind === "arm") arm(ctx, width, height, drawing, still ? frames(drawing) - 1 : Math.floor(moment));
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
  const { travel = [], ground = null } = drawing;
  const ends = function* () {
    for (const frame of drawing.frames) for (const [x0, y0, x1, y1] of frame) yield* [[x0, y0], [x1, y1]];
    if (ground !== null) yield [0, ground];
  };
  const place = fit(width, height, bounds(drawing, ends));
  const scale = place([1, 0])[0] - place([0, 0])[0];
  if (ground !== null) floor(ctx, width, place, scale, ground, travel[at] ?? 0);
  const thick = Math.max(3, Math.min(9, 0.07 * scale));
  for (const back of [4, 2, 0]) {
    if (at - back < 0) continue;
    const behind = (travel[at] ?? 0) - (travel[at - back] ?? 0); // where the body was, on the ground that it stands on now
    const side = ground === null ? 0 : behind;
    ctx.globalAlpha = back ? 0.16 : 1;
    for (const [x0, y0, x1, y1] of drawing.frames[at - back]) stroke(ctx, [place([x0 - side, y0]), place([x1 - side, y1])], "--series-1", back ? thick / 2 : thick);
  }
  ctx.globalAlpha = 1;
  if (travel.length) note(ctx, `${number(travel[at], 1)} m`);
  const force = drawing.force[Math.min(at, drawing.force.length - 1)] ?? 0;
  ctx.fillStyle = ink("--raised");
  ctx.fillRect(2, height - 5, width - 4, 4);
  ctx.fillStyle = ink("--series-2");
  ctx.fillRect(2, height - 5, (width - 4) * force, 4);
}

/** The ground with a mark at every meter, which pass by as the body travels. */
function floor(ctx, width, place, scale, ground, travelled) {
  const [zero, level] = place([0, ground]);
  stroke(ctx, [[0, level + 2], [width, level + 2]], "--edge", 1.5);
  for (let meter = Math.ceil(travelled - zero / scale); zero + (meter - travelled) * scale <= width; meter += 1) {
    const x = zero + (meter - travelled) * scale;
    stroke(ctx, [[x, level + 2], [x, level + 7]], "--edge", meter % 5 ? 1 : 2.5);
  }
}

function note(ctx, text) {
  ctx.font = "11px system-ui, 'Liberation Sans', sans-serif";
  ctx.fillStyle = ink("--muted");
  ctx.fillText(text, 5, 14);
}

const TABLE = [[-0.3, 0.35, 0], [0.3, 0.35, 0], [0.3, 0.95, 0], [-0.3, 0.95, 0]];
const SHOULDER = [0, 0.08, 0.4];
const [UPPER, LOWER, WRIST] = [0.42, 0.5, 0.14]; // lengths in meters, about those of a Sawyer

/** Meta-World's arm from the side; the joints between shoulder and hand are not observed, so their angles are assumed. */
function arm(ctx, width, height, drawing, at) {
  const flat = fit(width, height, [-0.14, -0.12, 1.06, 0.72]);
  const place = ([x, y, z]) => flat([y - 0.3 * x, z - 0.22 * x]); // the viewer is at x > 0, a little above
  const [hand, object, goal] = [drawing.hand[at], drawing.object[at], drawing.goal];
  const below = ([x, y]) => [x, y, 0];
  ctx.fillStyle = ink("--raised");
  ctx.beginPath();
  TABLE.map(place).forEach(([x, y], index) => (index ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.fill();
  stroke(ctx, [...TABLE, TABLE[0]].map(place), "--line", 1);
  for (const point of [hand, object, goal]) stroke(ctx, [place(point), place(below(point))], "--edge", 1);
  const [gx, gy] = place(goal);
  ctx.strokeStyle = ink("--ok");
  ctx.lineWidth = 2;
  ctx.strokeRect(gx - 6, gy - 6, 12, 12);
  ctx.globalAlpha = 0.5;
  stroke(ctx, drawing.hand.slice(0, at + 1).map(place), "--series-1", 1);
  stroke(ctx, drawing.object.slice(0, at + 1).map(place), "--series-2", 1.5);
  ctx.globalAlpha = 1;
  const wrist = [hand[0], hand[1], hand[2] + WRIST];
  stroke(ctx, [[0, 0, 0], SHOULDER].map(place), "--edge", 9);
  stroke(ctx, [SHOULDER, elbow(wrist), wrist].map(place), "--series-1", 6);
  const palm = [hand[0], hand[1], hand[2] + 0.06];
  stroke(ctx, [wrist, palm].map(place), "--series-1", 4);
  for (const side of [-1, 1]) {
    const reach = side * (0.012 + 0.035 * (drawing.opening[at] ?? 0));
    stroke(ctx, [palm, [hand[0], hand[1] + reach, hand[2] + 0.04], [hand[0], hand[1] + reach, hand[2] - 0.01]].map(place), "--text", 2.5);
  }
  const [ox, oy] = place(object);
  ctx.fillStyle = ink("--series-2");
  ctx.fillRect(ox - 4.5, oy - 4.5, 9, 9);
}

/** The elbow above the line from shoulder to wrist, for the lengths of both links. */
function elbow(wrist) {
  const along = wrist.map((value, axis) => value - SHOULDER[axis]);
  const distance = Math.min(UPPER + LOWER - 1e-3, Math.max(0.1, Math.hypot(...along)));
  const forward = (UPPER ** 2 - LOWER ** 2 + distance ** 2) / (2 * distance);
  const up = Math.sqrt(Math.max(0, UPPER ** 2 - forward ** 2));
  const level = Math.hypot(along[0], along[1]) || 1e-6;
  const unit = along.map((value) => value / (Math.hypot(...along) || 1e-6));
  const slope = unit[2];
  const flatten = Math.sqrt(Math.max(0, 1 - slope ** 2));
  const normal = [(-slope * along[0]) / level, (-slope * along[1]) / level, flatten]; // square to the line, in its vertical plane
  return SHOULDER.map((value, axis) => value + forward * unit[axis] + up * normal[axis]);
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
