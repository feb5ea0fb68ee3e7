// Drawings of the room and of distributions over its cells.  A cell is the number x * size + y.

import { canvas, color } from "/assets/common.js";

const position = (room, cell) => [Math.floor(cell / room.size), cell % room.size];

export const cellName = (room, cell) => `(${position(room, cell).join(", ")})`;

/** The center of a cell on a canvas: x to the right, y upwards. */
function center(room, cell, side) {
  const [x, y] = position(room, cell);
  return [(x + 0.5) * side, (room.size - y - 0.5) * side];
}

function drawGrid(pen, room, width, side) {
  pen.strokeStyle = color("--line");
  pen.lineWidth = 1;
  pen.beginPath();
  for (let i = 0; i <= room.size; i++) {
    const at = Math.min(Math.max(Math.round(i * side), 0.5), width - 0.5);
    pen.moveTo(at, 0);
    pen.lineTo(at, width);
    pen.moveTo(0, at);
    pen.lineTo(width, at);
  }
  pen.stroke();
}

/** A frame around the goal's cell. */
function drawGoal(pen, room, side) {
  const [x, y] = center(room, room.goal, side);
  pen.strokeStyle = color("--series-3");
  pen.lineWidth = Math.max(2, side * 0.09);
  const inset = pen.lineWidth / 2 + 1;
  pen.strokeRect(x - side / 2 + inset, y - side / 2 + inset, side - 2 * inset, side - 2 * inset);
}

export function drawRoom(element, room) {
  const { pen, width } = canvas(element);
  const side = width / room.size;
  pen.fillStyle = color("--raised");
  pen.fillRect(0, 0, width, width);
  drawGrid(pen, room, width, side);
  const [gx, gy] = center(room, room.goal, side);
  pen.globalAlpha = 0.16;
  pen.fillStyle = color("--series-3");
  pen.fillRect(gx - side / 2, gy - side / 2, side, side);
  pen.globalAlpha = 1;
  drawGoal(pen, room, side);

  const points = room.path.map(([cell, cause], step) => {
    const [x, y] = center(room, cell, side);
    const turn = step * 2.4; // an offset that separates several visits to one cell
    const spread = side * 0.13;
    return [x + spread * Math.cos(turn), y + spread * Math.sin(turn), cause];
  });
  pen.lineJoin = "round";
  for (let i = 1; i < points.length; i++) {
    pen.globalAlpha = 0.2 + (0.65 * i) / points.length;
    pen.strokeStyle = color({ agent: "--series-1", random: "--series-2", person: "--series-4" }[points[i][2]]);
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(points[i - 1][0], points[i - 1][1]);
    pen.lineTo(points[i][0], points[i][1]);
    pen.stroke();
    pen.globalAlpha = 1;
    drawOverride(pen, points[i], side * 0.09);
  }
  const [x, y] = center(room, room.cell, side);
  pen.fillStyle = color("--series-1");
  pen.strokeStyle = color("--surface");
  pen.lineWidth = 3;
  pen.beginPath();
  pen.arc(x, y, side * 0.3, 0, 2 * Math.PI);
  pen.fill();
  pen.stroke();
  pen.lineWidth = 2;
  if (drawOverride(pen, [x, y, points.at(-1)[2]], side * 0.14)) pen.stroke();
}

/** Mark an overridden step: a triangle for a random override, a square for a manual one; false for the agent's own step. */
function drawOverride(pen, [x, y, cause], r) {
  if (cause !== "random" && cause !== "person") return false;
  pen.fillStyle = color(cause === "random" ? "--series-2" : "--series-4");
  pen.beginPath();
  if (cause === "random") {
    pen.moveTo(x, y - 1.3 * r);
    pen.lineTo(x + 1.3 * r, y + r);
    pen.lineTo(x - 1.3 * r, y + r);
    pen.closePath();
  } else {
    pen.rect(x - r, y - r, 2 * r, 2 * r);
  }
  pen.fill();
  return true;
}

function shade(pen, p, x, y, width, height) {
  pen.globalAlpha = Math.sqrt(p);
  pen.fillStyle = color("--accent");
  pen.fillRect(x, y, width, height);
  pen.globalAlpha = 1;
}

/** A heat map of a distribution over cells, with the goal framed. */
export function drawMap(element, room, probs) {
  const { pen, width } = canvas(element);
  const side = width / room.size;
  probs.forEach((p, cell) => {
    const [x, y] = center(room, cell, side);
    shade(pen, p, x - side / 2, y - side / 2, side, side);
  });
  drawGrid(pen, room, width, side);
  drawGoal(pen, room, side);
}

/** The color scale of the heat maps, from 0 to 1. */
export function drawScale(element) {
  const { pen, width, height } = canvas(element);
  for (let x = 0; x < width; x++) shade(pen, x / width, x, 0, Math.max(1.5, height), Math.max(1.5, height));
}
