// What the pages of the live view share: theme, colours for a canvas, events, commands.

const root = document.documentElement;
const repaints = [];

/** Call `paint` now and whenever the colours change. */
export function onTheme(paint) {
  repaints.push(paint);
  paint();
}

const known = new Map(); // colours, until the theme changes

function repaint() {
  known.clear();
  repaints.forEach((paint) => paint());
}

/** The theme button: light, dark, or what the system has. */
export function themeButton(button) {
  const words = { "": "Theme: system", light: "Theme: light", dark: "Theme: dark" };
  const show = (theme) => {
    if (theme) root.dataset.theme = theme;
    else delete root.dataset.theme;
    button.textContent = words[theme];
    repaint();
  };
  let theme = remembered("theme");
  if (!(theme in words)) theme = "";
  button.addEventListener("click", () => {
    const order = Object.keys(words);
    theme = order[(order.indexOf(theme) + 1) % order.length];
    remember("theme", theme);
    show(theme);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  show(theme);
}

function remembered(name) {
  try {
    return localStorage.getItem(name) ?? "";
  } catch {
    return "";
  }
}

function remember(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // A browser that keeps nothing: the choice lasts as long as the page.
  }
}

/** A canvas's context, cleared and as sharp as the screen, in CSS pixels; its width and height in them. */
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

/** What a custom property such as "--accent" is at present, as rgb(...), for a canvas. */
export function colour(name) {
  if (known.has(name)) return known.get(name);
  if (!probe.isConnected) document.body.append(probe);
  probe.style.color = `var(${name})`;
  known.set(name, getComputedStyle(probe).color);
  return known.get(name);
}

/** Listen to the server; `handlers` by name of event.  `status` is an element that says how it goes. */
export function listen(handlers, status) {
  const source = new EventSource("/events");
  const say = (kind, text) => {
    if (status.textContent === text) return;
    status.className = `badge ${kind}`;
    status.textContent = text;
  };
  source.onopen = () => say("ok", "live");
  source.onerror = () => say("bad", source.readyState === EventSource.CLOSED ? "ended: reload to try again" : "connecting again");
  for (const [name, handle] of Object.entries(handlers)) {
    source.addEventListener(name, (event) => handle(JSON.parse(event.data)));
  }
  return source;
}

/** Send a command; resolves to "" or to the line that says why not. */
export async function command(fields) {
  try {
    const answer = await fetch("/command", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(fields),
    });
    if (answer.ok) return "";
    const text = await answer.text();
    try {
      return JSON.parse(text).error ?? text;
    } catch {
      return text;
    }
  } catch {
    return "the server does not answer";
  }
}

/** A number with so many digits after the point, or a dash for none. */
export const number = (value, digits = 0) =>
  value === null || value === undefined ? "–" : value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
