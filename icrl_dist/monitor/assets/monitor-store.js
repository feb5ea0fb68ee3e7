// The state of a run on the page, with limits on its size.  docs/monitor.md lists the fields.

const VARIATIONS = 4096;
const EPISODES = 48;
const EVENTS = 200;
const POINTS = 900;
const NAMES = ["number", "t", "stored_per_s", "episodes_per_s", "steps_per_s", "fit_per_s", "loss", "lag", "unstored"];

export function emptyStore() {
  return {
    epoch: "",
    seq: -1,
    time: 0,
    run: {},
    workers: [],
    alerts: [],
    variations: new Map(),
    variationCount: 0,
    leftOut: 0,
    episodes: new Map(),
    history: { t: [] },
    series: Object.fromEntries(NAMES.map((name) => [name, []])),
    events: [],
    beliefs: {},
    ignored: {},
    replay: null,
    headline: "",
    past: "",
    averages: [],
    evaluation: null,
    changes: 0, // grows when variations change
  };
}

/** Apply a full snapshot or a change; false if a change before this one was missed. */
export function apply(store, snapshot) {
  if (snapshot.since === -1) Object.assign(store, emptyStore(), { changes: store.changes + 1 });
  else if (snapshot.epoch !== store.epoch || snapshot.since > store.seq) return false;
  else if (snapshot.seq < store.seq) return true;
  for (const name of ["epoch", "seq", "time", "run", "workers", "alerts", "ignored", "replay", "headline", "averages"]) store[name] = snapshot[name];
  store.variationCount = snapshot.variation_count;
  store.leftOut = snapshot.variations_left_out;
  for (const row of snapshot.variations) {
    if (store.variations.size < VARIATIONS || store.variations.has(row.name)) store.variations.set(row.name, row);
  }
  if (snapshot.variations.length || snapshot.evaluation || snapshot.past !== store.past) store.changes += 1;
  store.past = snapshot.past;
  if (snapshot.history) store.history = snapshot.history;
  if (snapshot.evaluation) store.evaluation = snapshot.evaluation;
  for (const episode of snapshot.episodes) {
    if (store.episodes.get(episode.name)?.identity === episode.identity) continue;
    store.episodes.delete(episode.name);
    store.episodes.set(episode.name, episode);
  }
  for (const name of store.episodes.keys()) {
    if (store.episodes.size <= EPISODES) break;
    store.episodes.delete(name);
  }
  append(store, snapshot);
  const beliefs = { ...store.beliefs, ...snapshot.beliefs };
  store.beliefs = Object.fromEntries(snapshot.believers.filter((worker) => Object.hasOwn(beliefs, worker)).map((worker) => [worker, beliefs[worker]]));
  return true;
}

function append(store, snapshot) {
  const known = store.series.number.at(-1) ?? -1;
  const first = snapshot.series.number.findIndex((each) => each > known);
  for (const name of NAMES) {
    const column = store.series[name];
    if (first >= 0) column.push(...snapshot.series[name].slice(first));
    if (column.length > POINTS) column.splice(0, column.length - POINTS);
  }
  const newest = store.events.at(-1)?.number ?? -1;
  store.events.push(...snapshot.events.filter((event) => event.number > newest));
  if (store.events.length > EVENTS) store.events.splice(0, store.events.length - EVENTS);
}

const ORDER = ["pretrain", "adapt", "evaluate"];

/** The later of two phases, by stage and round. */
export function later(one, other) {
  if (!one || !other) return one || other;
  const place = (name) => {
    const [stage, round] = name.split("/");
    return [ORDER.indexOf(stage), Number(round)];
  };
  const [[stage, round], [stage2, round2]] = [place(one), place(other)];
  return stage2 > stage || (stage2 === stage && round2 > round) ? other : one;
}

/** Mean of the last five returns of a variation's newest phase, or null. */
export function recent(row) {
  const returns = row.phases.at(-1)?.returns.slice(-5) ?? [];
  return returns.length ? returns.reduce((sum, value) => sum + value, 0) / returns.length : null;
}
