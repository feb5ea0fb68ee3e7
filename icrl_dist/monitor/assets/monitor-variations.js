// The table of variations and its filters, which also select the variations in the chart of returns.

import { number } from "./common.js";
import { drawAdaptation } from "./monitor-adaptation.js";
import { brief, byId, el, parameters, plural, setText, sparkline, sparklineElement } from "./monitor-dom.js";
import { recent } from "./monitor-store.js";
import { Table } from "./monitor-table.js";

const ROWS = 100; // rows shown at first and added by each click

/** A short text of an adversary: its kind and its strength. */
export function adversaryText(adversary) {
  const strength = ["p", "strength"].find((name) => typeof adversary.p === "number" ? name === "p" : name in adversary);
  return strength ? `${adversary.kind} ${strength} ${brief(adversary[strength])}` : String(adversary.kind ?? "?");
}

const share = (row) => (row.optimum > 0 && recent(row) !== null ? recent(row) / row.optimum : null);

function rise(row) {
  const returns = row.phases.at(-1)?.returns ?? [];
  return returns.length ? recent(row) - returns[0] : null;
}

const COLUMNS = [
  {
    name: "name", title: "Variation", about: "Task and variation", value: (row) => row.task * 1e7 + row.variation,
    fill: (cell, row) => {
      cell.replaceChildren(row.name);
      if (row.quarantine) cell.append(" ", el("span", { class: "badge bad", title: row.quarantine }, "quarantined"));
    },
  },
  {
    name: "adversary", title: "Adversary", value: (row) => adversaryText(row.adversary),
    fill: (cell, row) => {
      setText(cell, adversaryText(row.adversary));
      cell.title = parameters(row.adversary, ["kind"]);
    },
  },
  {
    name: "curve", title: "Returns", about: "Returns in the newest phase; sorted by the increase of the return", value: rise, first: "desc",
    fill: (cell, row) => {
      if (!cell.firstChild) cell.append(sparklineElement());
      const returns = row.phases.at(-1)?.returns ?? [];
      sparkline(cell.firstChild, row.phases.at(-1)?.trials ?? [], returns, Math.min(0, ...returns), Math.max(row.optimum ?? 0, ...returns));
    },
  },
  { name: "last", title: "Last", about: "Return of the last episode", number: true, first: "desc", value: (row) => row.phases.at(-1)?.returns.at(-1) ?? null, text: (row) => brief(row.phases.at(-1)?.returns.at(-1)) },
  { name: "optimum", title: "Optimum", about: "Exact optimal return", number: true, first: "desc", value: (row) => row.optimum, text: (row) => brief(row.optimum) },
  { name: "share", title: "Last 5", about: "Mean of the last five returns divided by the optimum", number: true, value: share, text: (row) => (share(row) === null ? "–" : `${number(100 * share(row))}%`) },
  { name: "episodes", title: "Episodes", about: "Episodes in the newest phase", number: true, first: "desc", value: (row) => row.phases.at(-1)?.returns.length ?? 0, text: (row) => number(row.phases.at(-1)?.returns.length ?? 0) },
];

export class Variations {
  constructor(store, open) {
    this.store = store;
    this.drawn = -1;
    this.kinds = "";
    this.table = new Table(byId("variation-table"), COLUMNS, {
      caption: "Variations: adversary, returns and optimum; Enter opens one",
      limit: ROWS,
      order: ["name", false],
      tie: (a, b) => a.task - b.task || a.variation - b.variation,
      open: (row) => open(row.name),
      decorate: (element, row) => element.classList.toggle("troubled", Boolean(row.quarantine)),
    });
    const redraw = () => this.draw(true);
    byId("task-filter").addEventListener("input", redraw);
    byId("adversary-filter").addEventListener("change", redraw);
    byId("quarantine-filter").addEventListener("click", (event) => {
      event.target.setAttribute("aria-pressed", String(event.target.getAttribute("aria-pressed") !== "true"));
      redraw();
    });
    byId("variation-show").addEventListener("click", () => {
      this.table.limit += ROWS;
      redraw();
    });
  }

  /** The variations that match the filters. */
  chosen() {
    const task = byId("task-filter").value.trim();
    const kind = byId("adversary-filter").value;
    const quarantined = byId("quarantine-filter").getAttribute("aria-pressed") === "true";
    return [...this.store.variations.values()].filter(
      (row) =>
        (!task || String(row.task) === task) &&
        (!kind || String(row.adversary.kind) === kind) &&
        (!quarantined || row.quarantine),
    );
  }

  draw(force = false) {
    if (!force && this.drawn === this.store.changes) return;
    this.drawn = this.store.changes;
    this.#updateKinds();
    const rows = this.chosen();
    const shown = this.table.draw(rows);
    const [all, planned] = [this.store.variationCount, this.store.run.variations];
    const count = planned && planned > all ? `${number(all)} of ${number(planned)}` : number(all);
    setText(byId("variation-count"), rows.length === this.store.variations.size ? count : `${number(rows.length)} selected of ${number(all)}`);
    const more = rows.length - shown;
    const notes = [
      more ? `${plural(more, "more row")} not shown` : "",
      this.store.leftOut ? `${number(this.store.leftOut)} beyond the limit` : "",
      this.store.variations.size && !rows.length ? "no variation matches the filters" : "",
    ];
    setText(byId("variation-more"), notes.filter(Boolean).join("; "));
    byId("variation-show").hidden = !more;
    drawAdaptation(rows, this.store);
  }

  #updateKinds() {
    const kinds = [...new Set([...this.store.variations.values()].filter((row) => row.adversary.kind).map((row) => String(row.adversary.kind)))].sort().slice(0, 50);
    if (kinds.join("\n") === this.kinds) return;
    this.kinds = kinds.join("\n");
    const select = byId("adversary-filter");
    const chosen = select.value;
    select.replaceChildren(el("option", { value: "" }, "all"), ...kinds.map((kind) => el("option", { value: kind }, kind)));
    select.value = kinds.includes(chosen) ? chosen : "";
  }
}
