// Shared by both pages: theme, colors for a canvas, server events, commands.

const root = document.documentElement;
const repaints = [];

/** Call `paint` now and after every change of the theme. */
export function onTheme(paint) {
  repaints.push(paint);
  paint();
}

const colors = new Map(); // by name of the custom property, until the theme changes

function repaint() {
  colors.clear();
  repaints.forEach((paint) => paint());
}

/** The theme button: light, dark, or the theme of the system. */
export function themeButton(button) {
  const labels = { "": "Theme: system", light: "Theme: light", dark: "Theme: dark" };
  const show = (theme) => {
    if (theme) root.dataset.theme = theme;
    else delete root.dataset.theme;
    button.textContent = labels[theme];
    repaint();
  };
  let theme = storedValue("theme");
  if (!(theme in labels)) theme = "";
  button.addEventListener("click", () => {
    const order = Object.keys(labels);
    theme = order[(order.indexOf(theme) + 1) % order.length];
    storeValue("theme", theme);
    show(theme);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  show(theme);
}

function storedValue(name) {
  try {
    return localStorage.getItem(name) ?? "";
  } catch {
    return "";
  }
}

function storeValue(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // The browser refuses storage: the choice lasts until the page is closed.
  }
}

/** A canvas's context, cleared and scaled to the resolution of the screen, with width and height in CSS pixels. */
export function canvas(element) {
  const [width, height] = [element.clientWidth, element.clientHeight];
  const ratio = window.devicePixelRatio || 1;
  if (element.width !== Math.round(width * ratio) || element.height !== Math.round(height * ratio)) {
    element.width = Math.round(width * ratio);
    element.height = Math.round(height * ratio);
  }
  const pen = element.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

const probe = document.createElement("span");
probe.hidden = true;

/** The present value of a custom property such as "--accent", as rgb(...), for a canvas. */
export function color(name) {
  if (colors.has(name)) return colors.get(name);
  if (!probe.isConnected) document.body.append(probe);
  probe.style.color = `var(${name})`;
  colors.set(name, getComputedStyle(probe).color);
  return colors.get(name);
}

/**
 * Connect to the server's events; `handlers` by name of event.  The element `status` shows the state of the connection:
 * "live" once every event has arrived at least once, so that the page shows the server's whole state.
 */
export function listen(handlers, status, address = "/events") {
  const source = new EventSource(address);
  const missing = new Set(Object.keys(handlers)); // events that have not arrived on this connection
  const show = (kind, text) => {
    if (status.textContent === text) return;
    status.className = `badge ${kind}`;
    status.textContent = text;
  };
  source.onerror = () => {
    for (const name of Object.keys(handlers)) missing.add(name);
    show("bad", source.readyState === EventSource.CLOSED ? "disconnected: reload the page" : "reconnecting");
  };
  for (const [name, handle] of Object.entries(handlers)) {
    source.addEventListener(name, (event) => {
      if (missing.delete(name) && !missing.size) show("ok", "live");
      handle(JSON.parse(event.data));
    });
  }
  return source;
}

const ANSWER_MS = 15000;
let waiting = []; // commands that have not been sent
let answered = Promise.resolve();

/**
 * Send a command after the answer to the one before it, so that they arrive in order; resolves to "" or to the error, one line.
 * With `replaces`, it takes the place of the last waiting command if that does the same: a slider sends many.
 */
export function command(fields, replaces = false) {
  const last = waiting.at(-1);
  if (replaces && last?.fields.do === fields.do) {
    last.fields = fields;
    return last.result;
  }
  const one = { fields };
  waiting.push(one);
  one.result = answered = answered.then(() => {
    waiting = waiting.filter((other) => other !== one);
    return post(one.fields);
  });
  return one.result;
}

async function post(fields) {
  try {
    const answer = await fetch("/command", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(fields),
      signal: AbortSignal.timeout(ANSWER_MS),
    });
    if (answer.ok) return "";
    const text = await answer.text();
    try {
      return JSON.parse(text).error ?? text;
    } catch {
      return text;
    }
  } catch {
    return "no answer from the server";
  }
}

/** A number with `digits` digits after the point; a dash for null. */
export const number = (value, digits = 0) =>
  value === null || value === undefined ? "–" : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
