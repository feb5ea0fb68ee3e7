// The runs of a folder: the list, the run that is shown, and the run that it is compared with.

import { number } from "./common.js";
import { badge, byId, clock, el, setText } from "./monitor-dom.js";
import { Table } from "./monitor-table.js";

const PERIOD_MS = 2000;

const day = (time) => (time && Math.abs(time) < 8e12 ? `${new Date(time * 1000).toLocaleDateString("en-CA")} ${clock(time).slice(0, 5)}` : "–");

export class Runs {
  /** `show()` is called when another run is to be shown, `compare()` when another run is to be compared. */
  constructor(show, compare) {
    Object.assign(this, { show, compare, folder: null, rows: [], single: false });
    const asked = new URLSearchParams(location.search);
    this.shown = asked.get("run");
    this.other = asked.get("compare");
    this.following = !this.shown;
    byId("follow").addEventListener("click", () => this.#follow(!this.following));
    this.table = new Table(byId("run-table"), this.#columns(), {
      caption: "Runs; Enter shows one",
      limit: Infinity,
      order: ["began", true],
      tie: (a, b) => (a.name < b.name ? -1 : 1),
      open: (row) => this.#select(row.name),
      decorate: (element, row) => {
        element.classList.toggle("shown", row.name === this.shown);
        if (row.name === this.shown) element.setAttribute("aria-current", "true");
        else element.removeAttribute("aria-current");
      },
    });
    setInterval(() => this.look(), PERIOD_MS);
  }

  /** Fetch the list; a page of one run has none. */
  async look() {
    if (this.single) return;
    let listed;
    try {
      listed = await (await fetch("/runs", { signal: AbortSignal.timeout(10_000) })).json();
    } catch {
      return; // the server does not answer; it is asked again
    }
    this.single = listed === null;
    if (this.single) return;
    this.folder = listed.folder;
    this.rows = listed.runs;
    if (this.other && (this.other === this.shown || !this.#row(this.other))) this.#compareWith(null);
    if (this.following && listed.newest !== this.shown) this.#change(listed.newest);
    this.#draw(listed.left_out);
  }

  #row(name) {
    return this.rows.find((row) => row.name === name);
  }

  #select(name) {
    if (name === this.shown) return;
    this.following = false;
    if (name === this.other) this.#compareWith(null);
    this.#change(name);
    this.#draw();
  }

  #follow(following) {
    this.following = following;
    const newest = this.rows[0]?.name ?? null;
    if (following && newest !== this.shown) this.#change(newest);
    this.#draw();
  }

  #change(name) {
    this.shown = name;
    if (name === this.other) this.#compareWith(null);
    this.#remember();
    this.show();
  }

  #compareWith(name) {
    this.other = name;
    this.#remember();
    this.compare();
    this.#draw();
  }

  /** The choice as the page's address, so that it can be reloaded and sent. */
  #remember() {
    const asked = new URLSearchParams();
    if (!this.following && this.shown) asked.set("run", this.shown);
    if (this.other) asked.set("compare", this.other);
    history.replaceState(null, "", asked.size ? `?${asked}` : "/");
  }

  /** The part of an address that names a run of the folder; empty for a page of one run. */
  query(name = this.shown) {
    return this.folder === null ? "" : `?run=${encodeURIComponent(name)}`;
  }

  /** Fields of a command that name the run. */
  get named() {
    return this.folder === null ? {} : { run: this.shown };
  }

  /** Why a run has nothing to show yet; empty if it has. */
  waiting(name = this.shown) {
    if (this.folder === null) return "";
    if (name === null) return `Waiting for the first run in ${this.folder}: icrl-dist train ... --out ${this.folder}/NAME`;
    const row = this.#row(name);
    if (!row) return this.rows.length ? `There is no run ${name} in ${this.folder}.` : "";
    return row.note || (row.state === "starting" ? `${name} is starting: it is shown once its learner listens.` : "");
  }

  #draw(leftOut = this.leftOut) {
    if (this.folder === null) return;
    this.leftOut = leftOut;
    byId("runs").hidden = false;
    setText(byId("runs-folder"), `in ${this.folder}`);
    byId("follow").setAttribute("aria-pressed", String(this.following));
    this.table.draw(this.rows.map((row) => ({ ...row })));
    const none = "No run yet: the first one is shown when it begins.";
    setText(byId("runs-note"), !this.rows.length ? none : leftOut ? `${number(leftOut)} older runs are not listed.` : "");
  }

  #columns() {
    const text = (name, title) => ({ name, title, value: (row) => row[name].toLowerCase(), text: (row) => row[name] || "–" });
    const state = (cell, row) => {
      if (!cell.firstChild) cell.append(el("span"));
      badge(cell.firstChild, row.state);
      cell.title = row.note;
    };
    const compare = (cell, row) => {
      if (!cell.firstChild) cell.append(this.#compareButton());
      const [button, own, on] = [cell.firstChild, row.name === this.shown, row.name === this.other];
      button.name = row.name;
      button.disabled = own;
      button.setAttribute("aria-pressed", String(on));
      button.setAttribute("aria-label", own ? `${row.name} is shown` : on ? `End the comparison with ${row.name}` : `Compare ${this.shown} with ${row.name}`);
      setText(button, own ? "Shown" : on ? "Compared" : "Compare");
    };
    return [
      { ...text("name", "Run"), fill: (cell, row) => (setText(cell, row.name), (cell.title = row.name)) },
      { ...text("state", "State"), fill: state },
      { ...text("method", "Method"), text: (row) => row.method.toUpperCase().replaceAll("_", "-") || "–" },
      text("problem", "Problem"),
      { ...text("held_out", "Held-out result"), text: (row) => row.held_out.replace(/^held-out /, "") || "–" },
      { name: "began", title: "Begun", about: "When it was begun or resumed", first: "desc", value: (row) => row.began, text: (row) => day(row.began) },
      { name: "compare", title: "Compare", value: (row) => (row.name === this.shown ? 0 : row.name === this.other ? 1 : 2), fill: compare },
    ];
  }

  #compareButton() {
    const button = el("button", { type: "button", class: "small-button" });
    button.addEventListener("click", (event) => {
      event.stopPropagation(); // a click on the row shows the run
      this.#compareWith(button.name === this.other ? null : button.name);
    });
    button.addEventListener("keydown", (event) => event.stopPropagation());
    return button;
  }
}
