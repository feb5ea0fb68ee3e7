// A table that is sorted by its columns and keeps row elements, focus and scroll position.

import { el, setText } from "./monitor-dom.js";

/**
 * `columns`: name, title, value (to sort by), fill (cell, item) or text, number (right-aligned), first ("desc" or "asc").
 * `options`: caption, limit of rows, order (name, descending), decorate (tr, item), open (item), tie (item to text).
 */
export class Table {
  constructor(place, columns, options) {
    this.columns = columns;
    this.options = options;
    this.limit = options.limit;
    this.order = options.order;
    this.rows = new Map();
    this.heads = columns.map((column) => this.#head(column));
    this.body = el("tbody");
    const caption = el("caption", { class: "hidden-visually" }, options.caption);
    place.append(el("table", {}, caption, el("thead", {}, el("tr", {}, ...this.heads)), this.body));
    this.#mark();
  }

  #head(column) {
    const button = el("button", { type: "button", class: "sort", title: column.about ?? null }, column.title);
    button.addEventListener("click", () => {
      const [name, descending] = this.order;
      this.order = [column.name, name === column.name ? !descending : column.first === "desc"];
      this.#mark();
      this.draw(this.items ?? []);
    });
    return el("th", { scope: "col", class: column.number ? "number" : null }, button);
  }

  #mark() {
    this.columns.forEach((column, index) => {
      const sorted = this.order[0] === column.name ? (this.order[1] ? "descending" : "ascending") : "none";
      this.heads[index].setAttribute("aria-sort", sorted);
    });
  }

  /** Show at most `limit` of the items, sorted; returns the number shown. */
  draw(items) {
    this.items = items;
    const column = this.columns.find((each) => each.name === this.order[0]);
    const sign = this.order[1] ? -1 : 1;
    const keyed = items.map((item) => [column.value(item), item]);
    keyed.sort(([one, a], [other, b]) => {
      if (one === null || other === null) return (one === null) - (other === null) || this.#tie(a, b);
      return (one < other ? -sign : one > other ? sign : 0) || this.#tie(a, b);
    });
    const shown = keyed.slice(0, this.limit).map(([, item]) => item);
    this.#place(shown);
    return shown.length;
  }

  #tie(a, b) {
    return this.options.tie(a, b);
  }

  #place(items) {
    const names = new Set(items.map((item) => item.name));
    for (const [name, row] of this.rows) {
      if (!names.has(name)) {
        row.element.remove();
        this.rows.delete(name);
      }
    }
    const focused = document.activeElement;
    let next = this.body.firstChild;
    for (const item of items) {
      const row = this.rows.get(item.name) ?? this.#row(item.name);
      if (row.item !== item) {
        row.item = item;
        this.columns.forEach((column, index) => {
          if (column.fill) column.fill(row.cells[index], item);
          else setText(row.cells[index], column.text(item));
        });
        this.options.decorate?.(row.element, item);
      }
      if (row.element === next) next = next.nextSibling;
      else this.body.insertBefore(row.element, next);
    }
    if (focused !== document.activeElement && this.body.contains(focused)) focused.focus({ preventScroll: true });
  }

  #row(name) {
    const cells = this.columns.map((column, index) =>
      el(index === 0 ? "th" : "td", { class: column.number ? "number" : null, scope: index === 0 ? "row" : null }),
    );
    const element = el("tr", {}, ...cells);
    const row = { element, cells, item: null };
    if (this.options.open) {
      element.tabIndex = 0;
      element.className = "opens";
      element.addEventListener("click", () => this.options.open(row.item));
      element.addEventListener("keydown", (event) => {
        if (event.key === "Enter" || event.key === " ") {
          event.preventDefault();
          this.options.open(row.item);
        }
      });
    }
    this.rows.set(name, row);
    return row;
  }
}
