// Header, alerts, controls of a recording, workers and events.

import { command, number } from "./common.js";
import { badge, brief, byId, clock, el, parameters, plural, reasons, setText, span } from "./monitor-dom.js";
import { Table } from "./monitor-table.js";

export function drawHeader({ run, alerts, replay, headline }) {
  setText(byId("name"), run.name || "Waiting for a run");
  const warned = alerts.length ? `(${plural(alerts.length, "alert")}) ` : "";
  document.title = run.name ? `${warned}${run.name}: ${run.state}` : "icrl-dist: live view";
  badge(byId("state"), replay?.loading ? "loading" : (run.state ?? "waiting"), alerts.length);
  setText(byId("headline"), replay?.loading ? "Reading the recording: the page does not show the chosen moment yet." : headline);
  setText(byId("what"), [run.method?.toUpperCase().replaceAll("_", "-"), run.problem].filter(Boolean).join(" · "));
  const over = ["finished", "evaluating", "interrupted", "failed"].includes(run.state);
  const fit = run.stage === "fit";
  setText(byId("stage"), run.stage_text || "no stage yet");
  const steps = run.steps ?? 0;
  setText(byId("steps"), steps ? `${number(run.step)} of ${number(steps)} ${fit ? "steps" : "trajectories"} · ${Math.floor((100 * run.step) / steps)}%` : "");
  byId("bar").value = steps ? Math.min(1, run.step / steps) : 0;
  setText(byId("round"), run.round_text ? (run.phase === "adapt" ? `${run.round + 1}${run.rounds ? ` of ${number(run.rounds)}` : ""} (${run.phase}/${run.round})` : `${run.phase}/${run.round}`) : "–");
  setText(byId("elapsed"), span(run.elapsed_s));
  setText(byId("stage-eta"), over ? "–" : span(run.stage_eta_s));
  setText(byId("eta"), over ? "–" : span(run.eta_s));
  setText(byId("version"), run.version >= 0 ? `T^${run.version}` : "none yet");
  setText(byId("trajectories"), number(run.trajectories ?? 0));
  setText(byId("loss"), brief(run.loss));
  byId("replay").hidden = !replay;
}

export function drawAlerts({ alerts }) {
  const place = byId("alerts");
  const texts = alerts.map((alert) => `${alert.text} (since ${clock(alert.since)})`);
  if (place.dataset.texts !== texts.join("\n")) {
    place.dataset.texts = texts.join("\n");
    const at = place.scrollTop;
    place.replaceChildren(...texts.map((text) => el("p", {}, el("strong", {}, "Alert: "), text)));
    place.scrollTop = at;
  }
  if (texts.length > 1) place.tabIndex = place.scrollHeight > place.clientHeight ? 0 : -1; // focusable if it can be scrolled
  else place.removeAttribute("tabindex");
}

const SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 500];

/** The controls of a recording. */
export class Replay {
  /** `named()`: the fields of a command that name the run. */
  constructor(named) {
    this.named = named;
    this.dragging = false;
    this.speeds = "";
    this.replay = null;
    byId("pause").addEventListener("click", () => this.#send(this.#ended() ? { at: this.replay.begin, paused: false } : { paused: !this.replay.paused }));
    byId("speed").addEventListener("change", (event) => this.#send({ speed: Number(event.target.value) }));
    const seek = byId("seek");
    seek.addEventListener("input", () => {
      this.dragging = true;
      setText(byId("at"), this.#positionText(this.#selectedTime()));
      seek.setAttribute("aria-valuetext", this.#positionText(this.#selectedTime()));
    });
    seek.addEventListener("change", async () => {
      await this.#send({ at: this.#selectedTime() });
      this.dragging = false;
    });
  }

  async #send(fields) {
    setText(byId("replay-error"), await command({ ...this.named(), ...fields }));
  }

  #ended() {
    return this.replay.at >= this.replay.end;
  }

  #selectedTime() {
    const { begin, end } = this.replay;
    return begin + ((end - begin) * Number(byId("seek").value)) / 1000;
  }

  #positionText(at) {
    const { begin, end } = this.replay;
    return `${span(at - begin)} of ${span(end - begin)}`;
  }

  draw({ replay }) {
    if (!replay) return;
    this.replay = replay;
    setText(byId("pause"), this.#ended() ? "Play again" : replay.paused ? "Play" : "Pause");
    const speeds = [...new Set([...SPEEDS, replay.speed])].sort((a, b) => a - b);
    if (speeds.join() !== this.speeds) {
      this.speeds = speeds.join();
      byId("speed").replaceChildren(...speeds.map((speed) => el("option", { value: speed }, `${brief(speed)}×`)));
    }
    if (document.activeElement !== byId("speed")) byId("speed").value = String(replay.speed);
    if (this.dragging) return;
    byId("seek").value = String(Math.round((1000 * (replay.at - replay.begin)) / Math.max(1e-9, replay.end - replay.begin)));
    setText(byId("at"), this.#positionText(replay.at));
    byId("seek").setAttribute("aria-valuetext", this.#positionText(replay.at));
  }
}

const TROUBLE = { gone: 0, silent: 1, working: 2, waiting: 3, done: 4 };
const ROWS = 200;
const count = (name, title, about, first = "desc") => ({ name, title, about, first, number: true, value: (row) => row[name], text: (row) => brief(row[name]) });

const COLUMNS = [
  { name: "name", title: "Worker", value: (row) => row.name, text: (row) => row.name },
  {
    name: "state", title: "State", about: "Trouble first", value: (row) => TROUBLE[row.state] ?? 9,
    fill: (cell, row) => {
      if (!cell.firstChild) cell.append(el("span"));
      badge(cell.firstChild, row.state);
      cell.title = row.state === "gone" || row.state === "silent" ? `no heartbeat for ${span(row.silent_s)}` : row.doing;
    },
  },
  { name: "job", title: "Job", value: (row) => row.job, fill: (cell, row) => (setText(cell, row.job || "–"), (cell.title = row.doing)) },
  count("steps_per_s", "Steps/s", "Environment steps a second"),
  count("unstored", "Unstored", "Finished episodes that the learner has not stored yet"),
  count("lag", "Lag", "Number of versions between the weights of its job and the newest weights"),
  count("restarts", "Restarts", "Number of restarts as a new process"),
  { ...count("memory_mb", "MB", "Resident memory, megabytes"), text: (row) => (row.memory_mb ? number(row.memory_mb) : "–") },
];

export class Workers {
  constructor() {
    this.table = new Table(byId("worker-table"), COLUMNS, {
      caption: "Workers, trouble first",
      limit: ROWS,
      order: ["state", false],
      tie: (a, b) => (a.name < b.name ? -1 : 1),
      decorate: (element, row) => {
        element.dataset.state = row.state;
        element.classList.toggle("troubled", row.state === "gone" || row.state === "silent");
      },
    });
  }

  draw({ workers }) {
    const shown = this.table.draw(workers);
    const trouble = workers.filter((row) => row.state === "gone" || row.state === "silent").length;
    setText(byId("worker-count"), `${number(workers.length)}${trouble ? `, ${number(trouble)} in trouble` : ""}`);
    byId("worker-more").hidden = shown >= workers.length;
    setText(byId("worker-more"), `${plural(workers.length - shown, "more worker")} not shown`);
  }
}

/** Events, newest first; only new events are added to the page. */
export class Events {
  constructor() {
    this.newest = -1;
  }

  clear() {
    this.newest = -1;
    byId("events").replaceChildren();
  }

  draw({ events, run, ignored }) {
    const list = byId("events");
    const at = list.scrollTop;
    const before = list.scrollHeight;
    for (const event of events) {
      if (event.number <= this.newest) continue;
      this.newest = event.number;
      const time = el("time", { class: "muted small" }, clock(event.time));
      list.prepend(el("li", { "data-what": event.what }, time, el("span", { class: "what small" }, event.what), el("span", {}, event.text)));
    }
    while (list.children.length > 200) list.lastChild.remove();
    if (at > 4) list.scrollTop = at + list.scrollHeight - before;
    setText(byId("drops"), reasons(run.drops));
    setText(byId("ignored"), reasons(ignored));
  }
}

const adversaryText = (adversary) => [String(adversary.kind ?? "?"), parameters(adversary, ["kind"])].filter(Boolean).join(": ");

export const factsOf = (row) => [
  ["Task", parameters(row.parameters) || "–"],
  ["Adversary", adversaryText(row.adversary)],
  ...row.phases.slice(0, -1).map((phase) => [`Adversary of ${phase.name}`, adversaryText(phase.adversary)]).filter(([, text]) => text !== adversaryText(row.adversary)),
  ["Optimal return, expected", brief(row.optimum)],
  ...(row.quarantine ? [["Quarantined", row.quarantine]] : []),
];
