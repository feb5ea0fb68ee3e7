// The page of `icrl-dist play`: shows the state that the server sends, and sends the person's commands.

import { command, listen, number, onTheme, themeButton } from "/assets/common.js";
import { ReturnChart, drawGauge, returnRows } from "/assets/play-charts.js";
import { cellName, drawMap, drawRoom, drawScale } from "/assets/play-room.js";

const $ = (id) => document.getElementById(id);
let room = null;
let belief = null;
let episodes = null;

async function send(fields, replaces = false) {
  $("error").textContent = await command(fields, replaces);
}

// The room and the controls.

function showRoom() {
  drawRoom($("room"), room);
  const causes = room.path.map(([, cause]) => cause);
  const manual = causes.filter((cause) => cause === "person").length;
  const random = causes.filter((cause) => cause === "random").length;
  $("episode").textContent = room.episode;
  $("step").textContent = `${room.step} of ${room.horizon}`;
  $("total").textContent = number(room.total);
  $("overridden").textContent = manual ? `${random + manual} (${manual} you)` : `${random}`;
  $("optimum").textContent = `expected optimum here: ${number(room.optimum, 1)}`;
  $("room").setAttribute(
    "aria-label",
    `A room of ${room.size} by ${room.size} cells. Agent at ${cellName(room, room.cell)}, goal at ${cellName(room, room.goal)}, ` +
      `step ${room.step}, return ${number(room.total)}, ${random} steps overridden at random, ${manual} by you.`,
  );
  $("pause").textContent = room.paused ? "Resume" : "Pause";
  setControl($("speed"), Math.round(fromSpeed(room.speed)));
  $("speed-text").textContent = `${number(room.speed, room.speed < 10 ? 1 : 0)} steps a second`;
  setControl($("p"), room.p);
  $("p-text").textContent = number(room.p, 2);
  setControl($("distribution"), room.distribution ?? "");
  $("keep").checked = room.keep;
  for (const name of ["goal-x", "goal-y"]) $(name).max = room.size - 1;
  for (const button of document.querySelectorAll("[data-push]")) {
    button.setAttribute("aria-pressed", String(Number(button.dataset.push) === room.held));
  }
  showSurprise();
}

/** Show the game's value, unless the person is moving this control. */
function setControl(control, value) {
  if (document.activeElement !== control) control.value = value;
}

function showSurprise() {
  const value = room.surprise;
  const verdict = value === null ? "not measured" : value < 1 ? "as in training" : "unlike training: do not trust it";
  $("surprise-text").textContent = value === null ? verdict : `${number(value, 2)}, ${verdict}`;
  $("surprise-text").className = value === null ? "muted" : value < 1 ? "ok" : "bad";
  $("surprise").setAttribute("aria-valuenow", value ?? 0);
  $("surprise").setAttribute("aria-valuetext", $("surprise-text").textContent);
  drawGauge($("gauge"), value);
}

// The posteriors over the goal.

function showMap(element, probs, title) {
  drawMap(element, room, probs);
  const best = probs.indexOf(Math.max(...probs));
  const possible = probs.filter((p) => p > 0.001).length;
  element.setAttribute(
    "aria-label",
    `${title}: most likely ${cellName(room, best)} with ${number(100 * probs[best])} %, ${possible} cells above 0.1 %; ` +
      `${number(100 * probs[room.goal])} % at the goal`,
  );
}

function showBelief() {
  if (!belief || !room || belief.implied.length !== room.size ** 2) return;
  showMap($("implied"), belief.implied, "Implied by its actions");
  showMap($("exact"), belief.exact, "The exact posterior");
  drawScale($("scale"));
  $("apart").textContent = `total variation distance ${number(100 * belief.apart)} %`;
  $("fit").textContent =
    `Its action distributions differ from that mixture by ${number(belief.divergence, 3)} nats a cell; ` +
    `its context has ${number(belief.transitions)} of at most ${number(room.context_max)} transitions.`;
}

// Returns.

const chart = new ReturnChart($("chart"));

function showEpisodes() {
  if (!episodes) return;
  const numbers = episodes.total.map((_, i) => episodes.first + i);
  chart.draw(numbers, episodes, room?.horizon ?? 100);
  $("returns").replaceChildren(...returnRows(numbers, episodes));
  const last = episodes.total.length - 1;
  const summary = last < 0 ? "no episode has ended yet" : `episode ${numbers[last]} has return ${number(episodes.total[last])}`;
  $("chart").setAttribute("aria-label", `Return by episode: ${summary}`);
  if (last >= 0) $("announcement").textContent = summary;
}

// Commands.

const SLOWEST = 0.5;
const FASTEST = 100;
const toSpeed = (at) => SLOWEST * (FASTEST / SLOWEST) ** (at / 100);
const fromSpeed = (speed) => (100 * Math.log(speed / SLOWEST)) / Math.log(FASTEST / SLOWEST);

$("pause").addEventListener("click", () => send({ do: "pause", value: !room?.paused }));
$("one").addEventListener("click", () => send({ do: "step" }));
$("through").addEventListener("click", () => send({ do: "episode" }));
$("new").addEventListener("click", () => send({ do: "new" }));
$("speed").addEventListener("input", () => send({ do: "speed", value: Math.min(FASTEST, Number(toSpeed($("speed").value).toFixed(2))) }, true));
$("p").addEventListener("input", () => send({ do: "p", value: Number($("p").value) }, true));
$("distribution").addEventListener("change", ({ target }) =>
  send({ do: "distribution", value: target.value === "" ? null : Number(target.value) }),
);
$("keep").addEventListener("change", () => send({ do: "keep", value: $("keep").checked }));
$("goal-form").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ do: "goal", value: [Number($("goal-x").value), Number($("goal-y").value)] });
});
$("room").addEventListener("click", (event) => {
  if (!room) return;
  const box = $("room").getBoundingClientRect();
  const cell = (at, extent) => Math.min(room.size - 1, Math.max(0, Math.floor((at / extent) * room.size)));
  send({ do: "goal", value: [cell(event.clientX - box.left, box.width), room.size - 1 - cell(event.clientY - box.top, box.height)] });
});

let renewal = null; // timer that repeats `hold`, which the server would end otherwise

function hold(action) {
  clearInterval(renewal);
  renewal = null;
  send({ do: "hold", value: action });
  if (action !== null) renewal = setInterval(() => send({ do: "hold", value: action }, true), 500);
}

const release = () => {
  if (renewal !== null) hold(null);
};

for (const button of document.querySelectorAll("[data-push]")) {
  const action = Number(button.dataset.push);
  button.addEventListener("pointerdown", () => hold(action));
  button.addEventListener("click", (event) => {
    if (event.detail === 0) send({ do: "push", value: action }); // a click by keyboard
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

// Events of the server, theme and size.

const handlers = {
  room: (newest) => {
    const sameGoal = room?.goal === newest.goal;
    room = newest;
    showRoom();
    if (!sameGoal) showBelief();
  },
  belief: (newest) => {
    belief = newest;
    showBelief();
  },
  episodes: (newest) => {
    episodes = newest;
    showEpisodes();
  },
};

const paint = () => {
  chart.remake();
  showEpisodes();
  if (room) showRoom();
  showBelief();
};

themeButton($("theme"));
onTheme(paint);
new ResizeObserver(() => {
  chart.resize();
  if (room) showRoom();
  showBelief();
}).observe(document.querySelector(".columns"));
listen(handlers, $("status"));
