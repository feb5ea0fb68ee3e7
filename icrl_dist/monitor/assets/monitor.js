// The live view: receives snapshots, keeps the newest state, draws it.  docs/monitor.md describes the events.

import { listen, themeButton } from "./common.js";
import { Timeline, watchTheme } from "./monitor-charts.js";
import { Detail } from "./monitor-detail.js";
import { byId, brief, setText } from "./monitor-dom.js";
import { Beliefs, Episodes } from "./monitor-episodes.js";
import { HeldOut } from "./monitor-heldout.js";
import { Events, Replay, Workers, drawAlerts, drawHeader } from "./monitor-panels.js";
import { apply, emptyStore } from "./monitor-store.js";
import { Variations } from "./monitor-variations.js";

const STALE_MS = 3000;
const CHECK_MS = 2000;

const store = emptyStore();
let detail = null;
const open = (name) => detail.open(name);
const episodes = new Episodes(store, open);
detail = new Detail(store, episodes);
const variations = new Variations(store, open);
const workers = new Workers();
const events = new Events();
const replay = new Replay();
const beliefs = new Beliefs();
const heldOut = new HeldOut();

const timelines = [
  ["throughput", [
    { name: "stored_per_s", label: "stored", ink: "--series-1" },
    { name: "episodes_per_s", label: "episodes", ink: "--series-2", dash: [5, 3] },
    { name: "fit_per_s", label: "fit steps", ink: "--series-3" },
  ]],
  ["backlog", [
    { name: "unstored", label: "not yet stored", ink: "--series-4" },
    { name: "lag", label: "lag", ink: "--series-5", dash: [5, 3] },
  ]],
  ["losses", [{ name: "loss", label: "loss", ink: "--series-1", points: true }]],
].map(([id, names]) => ({ id, names, line: new Timeline(byId(id), names), title: byId(id).getAttribute("aria-label") }));

watchTheme();
themeButton(byId("theme"));

// Events of the server.

let lastEvent = performance.now();
let epoch = "";
let source = null;

function receive(snapshot) {
  lastEvent = performance.now();
  setText(byId("connection"), store.replay ? "playing" : "live");
  byId("connection").className = "badge ok";
  if (!apply(store, snapshot)) return connect(); // a change was missed: reconnect for a full snapshot
  if (store.epoch !== epoch) {
    epoch = store.epoch;
    episodes.clear();
    events.clear();
  }
}

function connect() {
  source?.close();
  source = listen({ picture: receive }, byId("connection"));
}

setInterval(() => {
  const silent = performance.now() - lastEvent;
  if (source.readyState === EventSource.CLOSED) connect();
  else if (source.readyState === EventSource.OPEN && silent > STALE_MS) {
    byId("connection").className = "badge warn";
    setText(byId("connection"), `stale: no update for ${Math.round(silent / 1000)} s`);
  }
  document.body.classList.toggle("stale", silent > STALE_MS);
}, CHECK_MS);

// Drawing: numbers four times a second, tables twice, charts once.

const jobs = [
  [240, () => {
    drawHeader(store);
    drawAlerts(store);
    replay.draw(store);
    workers.draw(store);
    events.draw(store);
  }],
  [500, () => {
    variations.draw();
    heldOut.draw(store);
    detail.refresh();
    beliefs.draw(store.beliefs);
  }],
  [1000, () => {
    for (const { id, names, line, title } of timelines) {
      line.draw(store.series);
      const newest = names.map(({ name, label }) => `${label} ${brief(store.series[name].at(-1))}`).join(", ");
      byId(id).setAttribute("aria-label", `${title}; now ${newest}`);
    }
  }],
].map(([every, paint]) => ({ every, paint, last: -Infinity }));

function frame(now) {
  requestAnimationFrame(frame);
  if (store.seq < 0) return;
  for (const job of jobs) {
    if (now - job.last < job.every) continue;
    job.last = now;
    job.paint();
  }
}

connect();
requestAnimationFrame(frame);
