// The live view: receives snapshots, keeps the newest state, draws it.  docs/monitor.md describes the events.

import { listen, themeButton } from "./common.js";
import { Timeline, watchTheme } from "./monitor-charts.js";
import { Detail } from "./monitor-detail.js";
import { badge, byId, brief, setText } from "./monitor-dom.js";
import { Beliefs, Episodes } from "./monitor-episodes.js";
import { HeldOut } from "./monitor-heldout.js";
import { Events, Replay, Workers, drawAlerts, drawHeader } from "./monitor-panels.js";
import { apply, emptyStore } from "./monitor-store.js";
import { Comparison } from "./monitor-compare.js";
import { Runs } from "./monitor-runs.js";
import { Variations } from "./monitor-variations.js";

const STALE_MS = 3000;
const CHECK_MS = 2000;

const store = emptyStore();
let detail = null;
const open = (name) => detail.open(name);
const episodes = new Episodes(store, open);
const runs = new Runs(connect, connectOther);
detail = new Detail(store, episodes, runs);
const variations = new Variations(store, open);
const workers = new Workers();
const events = new Events();
const replay = new Replay(() => runs.named);
const comparison = new Comparison();
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
let connected = "";

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
  source = null;
  const shown = `${runs.folder}\n${runs.shown}`;
  if (shown !== connected) Object.assign(store, emptyStore(), { changes: store.changes + 1 }); // another run: nothing of the one before remains
  connected = shown;
  if (waiting()) return;
  source = listen({ picture: receive }, byId("connection"), `/events${runs.query()}`);
}

/** Show why there is nothing to show yet; false if there is. */
function waiting() {
  const text = runs.waiting();
  if (!text) return false;
  setText(byId("name"), runs.shown ?? "Waiting for a run");
  badge(byId("state"), "waiting");
  setText(byId("headline"), text);
  byId("connection").className = "badge muted";
  setText(byId("connection"), "waiting");
  document.body.classList.add("stale");
  return true;
}

// The run that the shown one is compared with.

const other = emptyStore();
let otherSource = null;

function connectOther() {
  otherSource?.close();
  otherSource = null;
  Object.assign(other, emptyStore());
  if (runs.other === null) return comparison.hide();
  if (runs.waiting(runs.other)) return;
  otherSource = new EventSource(`/events${runs.query(runs.other)}`);
  otherSource.addEventListener("picture", ({ data }) => apply(other, JSON.parse(data)) || connectOther());
}

setInterval(() => {
  if (runs.folder !== null && runs.other !== null && (!otherSource || otherSource.readyState === EventSource.CLOSED)) connectOther();
  if (!source) {
    if (!waiting()) connect();
    return;
  }
  const silent = performance.now() - lastEvent;
  if (source.readyState === EventSource.CLOSED) connect();
  else if (source.readyState === EventSource.OPEN && silent > STALE_MS) {
    byId("connection").className = "badge warn";
    setText(byId("connection"), `stale: no update for ${Math.round(silent / 1000)} s`);
  }
  document.body.classList.toggle("stale", silent > STALE_MS);
}, CHECK_MS);

/** Show all on one screen if it has room for everything: more of it for the list of a folder, never for a comparison. */
function arrange() {
  const least = runs.folder === null ? 780 : 1000;
  document.body.classList.toggle("fixed", runs.other === null && innerWidth >= 1200 && innerHeight >= least);
}
addEventListener("resize", arrange);

// Drawing: numbers four times a second, tables twice, charts once.

const jobs = [
  [240, () => {
    arrange();
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
    if (runs.other !== null) comparison.draw([store, other], [runs.shown, runs.other], [runs.waiting(), runs.waiting(runs.other)]);
  }],
  [1000, () => {
    for (const { id, names, line, title } of timelines) {
      line.draw(store.series, store.history);
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

await runs.look(); // whether the page is of a folder or of one run
if (!source) connect();
if (runs.other !== null) connectOther();
requestAnimationFrame(frame);
