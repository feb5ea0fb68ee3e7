// The page of `icrl-dist play`: shows what the server tells, sends what the person does.

import { canvas, colour, command, listen, number, onTheme, themeButton } from "/assets/common.js";

const $ = (id) => document.getElementById(id);
let room = null;
let belief = null;
let episodes = null;

async function send(fields) {
  $("error").textContent = await command(fields);
}

// The room.

const xy = (cell) => [Math.floor(cell / room.size), cell % room.size];
const named = (cell) => `(${xy(cell).join(", ")})`;

/** The middle of a cell: x to the right, y upwards. */
function middle(cell, side) {
  const [x, y] = xy(cell);
  return [(x + 0.5) * side, (room.size - y - 0.5) * side];
}

function grid(pen, width, side) {
  pen.strokeStyle = colour("--line");
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

/** The frame around the goal's cell. */
function frame(pen, side) {
  const [x, y] = middle(room.goal, side);
  pen.strokeStyle = colour("--series-3");
  pen.lineWidth = Math.max(2, side * 0.09);
  const inset = pen.lineWidth / 2 + 1;
  pen.strokeRect(x - side / 2 + inset, y - side / 2 + inset, side - 2 * inset, side - 2 * inset);
}

function drawRoom() {
  const { pen, width } = canvas($("room"));
  const side = width / room.size;
  pen.fillStyle = colour("--raised");
  pen.fillRect(0, 0, width, width);
  grid(pen, width, side);
  const [gx, gy] = middle(room.goal, side);
  pen.globalAlpha = 0.16;
  pen.fillStyle = colour("--series-3");
  pen.fillRect(gx - side / 2, gy - side / 2, side, side);
  pen.globalAlpha = 1;
  frame(pen, side);

  const points = room.path.map(([cell, cause], step) => {
    const [x, y] = middle(cell, side);
    const turn = step * 2.4; // steps that fall on each other stay apart
    const spread = side * 0.13;
    return [x + spread * Math.cos(turn), y + spread * Math.sin(turn), cause];
  });
  pen.lineJoin = "round";
  for (let i = 1; i < points.length; i++) {
    pen.globalAlpha = 0.2 + (0.65 * i) / points.length;
    pen.strokeStyle = colour({ agent: "--series-1", law: "--series-2", hand: "--series-4" }[points[i][2]]);
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(points[i - 1][0], points[i - 1][1]);
    pen.lineTo(points[i][0], points[i][1]);
    pen.stroke();
    pen.globalAlpha = 1;
    mark(pen, points[i], side * 0.09);
  }
  const [x, y] = middle(room.cell, side);
  pen.fillStyle = colour("--series-1");
  pen.strokeStyle = colour("--surface");
  pen.lineWidth = 3;
  pen.beginPath();
  pen.arc(x, y, side * 0.3, 0, 2 * Math.PI);
  pen.fill();
  pen.stroke();
  pen.lineWidth = 2;
  if (mark(pen, [x, y, points.at(-1)[2]], side * 0.14)) pen.stroke();
}

/** An overridden step: a triangle for the law, a square for the hand; whether it was one. */
function mark(pen, [x, y, cause], r) {
  if (cause !== "law" && cause !== "hand") return false;
  pen.fillStyle = colour(cause === "law" ? "--series-2" : "--series-4");
  pen.beginPath();
  if (cause === "law") {
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

function showRoom() {
  drawRoom();
  const causes = room.path.map(([, cause]) => cause);
  const hand = causes.filter((cause) => cause === "hand").length;
  const law = causes.filter((cause) => cause === "law").length;
  $("episode").textContent = room.episode;
  $("step").textContent = `${room.step} of ${room.horizon}`;
  $("total").textContent = number(room.total);
  $("overridden").textContent = hand ? `${law + hand} (${hand} you)` : `${law}`;
  $("optimum").textContent = `the oracle earns ${number(room.optimum, 1)} here on average`;
  $("room").setAttribute(
    "aria-label",
    `A room of ${room.size} by ${room.size} cells. Agent at ${named(room.cell)}, goal at ${named(room.goal)}, ` +
      `step ${room.step}, return ${number(room.total)}, ${law} steps overridden by the law, ${hand} by you.`,
  );
  $("pause").textContent = room.paused ? "Go on" : "Pause";
  settle($("speed"), Math.round(fromSpeed(room.speed)));
  $("speed-text").textContent = `${number(room.speed, room.speed < 10 ? 1 : 0)} steps a second`;
  settle($("p"), room.p);
  $("p-text").textContent = number(room.p, 2);
  settle($("law"), room.law ?? "");
  $("keep").checked = room.keep;
  for (const name of ["goal-x", "goal-y"]) $(name).max = room.size - 1;
  for (const button of document.querySelectorAll("[data-push]")) {
    button.setAttribute("aria-pressed", String(Number(button.dataset.push) === room.held));
  }
  showSurprise();
}

/** Show the game's value, unless this control is being moved. */
function settle(control, value) {
  if (document.activeElement !== control) control.value = value;
}

// Surprise: a scale with its two landmarks.

const LOWEST = -1;
const HIGHEST = 4;

function showSurprise() {
  const value = room.surprise;
  const word = value === null ? "not measured" : value < 1 ? "as in training" : "unlike training: do not trust it";
  $("surprise-text").textContent = value === null ? word : `${number(value, 2)}, ${word}`;
  $("surprise-text").className = value === null ? "muted" : value < 1 ? "ok" : "bad";
  $("surprise").setAttribute("aria-valuenow", value ?? 0);
  $("surprise").setAttribute("aria-valuetext", $("surprise-text").textContent);
  const { pen, width, height } = canvas($("gauge"));
  const place = (v) => ((Math.min(Math.max(v, LOWEST), HIGHEST) - LOWEST) / (HIGHEST - LOWEST)) * (width - 12) + 6;
  pen.fillStyle = colour("--raised");
  pen.fillRect(6, 4, width - 12, 12);
  if (value !== null) {
    pen.fillStyle = colour(value < 1 ? "--ok" : "--bad");
    pen.fillRect(6, 4, place(value) - 6, 12);
  }
  pen.strokeStyle = colour("--text");
  pen.fillStyle = colour("--muted");
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  for (let v = LOWEST; v <= HIGHEST; v++) {
    pen.fillText(String(v), place(v), height - 3);
    if (v === 0 || v === 1) pen.strokeRect(place(v), 2, 0.5, 16);
  }
}

// The two beliefs.

const shade = (p) => Math.sqrt(p);

function heat(pen, p, x, y, side) {
  pen.globalAlpha = shade(p);
  pen.fillStyle = colour("--accent");
  pen.fillRect(x, y, side, side);
  pen.globalAlpha = 1;
}

function drawMap(element, law, title) {
  const { pen, width } = canvas(element);
  const side = width / room.size;
  law.forEach((p, cell) => {
    const [x, y] = middle(cell, side);
    heat(pen, p, x - side / 2, y - side / 2, side);
  });
  grid(pen, width, side);
  frame(pen, side);
  const best = law.indexOf(Math.max(...law));
  const possible = law.filter((p) => p > 0.001).length;
  element.setAttribute(
    "aria-label",
    `${title}: most likely ${named(best)} with ${number(100 * law[best])} %, ${possible} cells above 0.1 %; ` +
      `${number(100 * law[room.goal])} % where the goal is`,
  );
}

function showBelief() {
  if (!belief || !room || belief.implied.length !== room.size ** 2) return;
  drawMap($("implied"), belief.implied, "What its actions imply");
  drawMap($("exact"), belief.exact, "The exact posterior");
  const { pen, width, height } = canvas($("scale"));
  for (let x = 0; x < width; x++) heat(pen, x / width, x, 0, Math.max(1.5, height));
  $("apart").textContent = `${number(100 * belief.apart)} % of the belief lies elsewhere`;
  $("fit").textContent =
    `Its laws are ${number(belief.divergence, 3)} nats a cell from that mixture; ` +
    `${number(belief.transitions)} of at most ${number(room.context_max)} transitions are in its context.`;
}

// Returns.

let chart = null;

function makeChart() {
  const axis = () => ({
    stroke: colour("--muted"),
    grid: { stroke: colour("--line"), width: 1 },
    ticks: { stroke: colour("--line"), width: 1 },
    font: "12px system-ui, sans-serif",
  });
  chart?.destroy();
  chart = new uPlot(
    {
      width: $("chart").clientWidth,
      height: 210,
      legend: { show: true, live: true },
      cursor: { drag: { x: false, y: false } },
      scales: { x: { time: false, range: (_, low, high) => [Math.max(0, low - 0.5), Math.max(10.5, high + 0.5)] }, y: { range: [0, 100] } },
      axes: [
        { ...axis(), incrs: [1, 2, 5, 10, 20, 50, 100], size: 34 },
        { ...axis(), size: 40 },
      ],
      series: [
        { label: "episode" },
        { label: "return", stroke: colour("--series-1"), width: 2, points: { show: true, size: 6, fill: colour("--series-1") } },
        { label: "oracle, on average", stroke: colour("--series-3"), width: 2, dash: [7, 5], points: { show: false }, spanGaps: false },
      ],
    },
    [[], [], []],
    $("chart"),
  );
  showEpisodes();
}

function showEpisodes() {
  if (!episodes || !chart) return;
  const numbers = episodes.total.map((_, i) => episodes.first + i);
  chart.setScale("y", { min: 0, max: Math.max(10, room?.horizon ?? 100) });
  chart.setData([numbers, episodes.total, episodes.optimum]);
  const last = episodes.total.length - 1;
  const rows = numbers.map((n, i) => {
    const row = document.createElement("tr");
    const optimum = episodes.optimum[i] === null ? "changed meanwhile" : number(episodes.optimum[i], 1);
    [n, number(episodes.total[i]), optimum, episodes.overridden[i], episodes.by_hand[i]].forEach((value, column) => {
      const cell = document.createElement("td");
      if (column) cell.className = "number";
      cell.textContent = value;
      row.append(cell);
    });
    return row;
  });
  $("returns").replaceChildren(...rows.reverse());
  const said = last < 0 ? "no episode has ended yet" : `episode ${numbers[last]} earned ${number(episodes.total[last])}`;
  $("chart").setAttribute("aria-label", `Return by episode: ${said}`);
  if (last >= 0) $("said").textContent = said;
}

// What the person does.

const SLOWEST = 0.5;
const FASTEST = 100;
const toSpeed = (at) => SLOWEST * (FASTEST / SLOWEST) ** (at / 100);
const fromSpeed = (speed) => (100 * Math.log(speed / SLOWEST)) / Math.log(FASTEST / SLOWEST);

$("pause").addEventListener("click", () => send({ do: "pause", value: !room?.paused }));
$("one").addEventListener("click", () => send({ do: "step" }));
$("through").addEventListener("click", () => send({ do: "episode" }));
$("new").addEventListener("click", () => send({ do: "new" }));
$("speed").addEventListener("input", () => send({ do: "speed", value: Math.min(FASTEST, Number(toSpeed($("speed").value).toFixed(2))) }));
$("p").addEventListener("input", () => send({ do: "p", value: Number($("p").value) }));
$("law").addEventListener("change", () => send({ do: "law", value: $("law").value === "" ? null : Number($("law").value) }));
$("keep").addEventListener("change", () => send({ do: "keep", value: $("keep").checked }));
$("goal-form").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ do: "goal", value: [Number($("goal-x").value), Number($("goal-y").value)] });
});
$("room").addEventListener("click", (event) => {
  if (!room) return;
  const box = $("room").getBoundingClientRect();
  const cell = (at, of) => Math.min(room.size - 1, Math.max(0, Math.floor((at / of) * room.size)));
  send({ do: "goal", value: [cell(event.clientX - box.left, box.width), room.size - 1 - cell(event.clientY - box.top, box.height)] });
});

let renewing = null;

function hold(action) {
  clearInterval(renewing);
  renewing = null;
  send({ do: "hold", value: action });
  if (action !== null) renewing = setInterval(() => send({ do: "hold", value: action }), 500);
}

const release = () => {
  if (renewing !== null) hold(null);
};

for (const button of document.querySelectorAll("[data-push]")) {
  const action = Number(button.dataset.push);
  button.addEventListener("pointerdown", () => hold(action));
  button.addEventListener("click", (event) => {
    if (event.detail === 0) send({ do: "push", value: action }); // by the keyboard
  });
}
for (const name of ["pointerup", "pointercancel", "blur"]) window.addEventListener(name, release);

const KEYS = { ArrowRight: 0, ArrowLeft: 1, ArrowUp: 2, ArrowDown: 3, " ": 4 };
$("room").addEventListener("keydown", (event) => {
  if (!(event.key in KEYS)) return;
  event.preventDefault();
  if (!event.repeat) hold(KEYS[event.key]);
});
$("room").addEventListener("keyup", (event) => {
  if (event.key in KEYS) release();
});
$("room").addEventListener("blur", release);

// All of it.

const handlers = {
  room: (told) => {
    const framed = room?.goal === told.goal;
    room = told;
    showRoom();
    if (!framed) showBelief();
  },
  belief: (told) => {
    belief = told;
    showBelief();
  },
  episodes: (told) => {
    episodes = told;
    showEpisodes();
  },
};

const paint = () => {
  makeChart();
  if (room) showRoom();
  showBelief();
};

themeButton($("theme"));
onTheme(paint);
new ResizeObserver(() => {
  chart?.setSize({ width: $("chart").clientWidth, height: 210 });
  if (room) showRoom();
  showBelief();
}).observe(document.querySelector(".columns"));
listen(handlers, $("status"));
