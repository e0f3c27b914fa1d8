// The columns as a table that can be sorted; a click on a row shows the column in time.

import { h, setText } from "./dom.js";
import { several } from "./format.js";

/**
 * @import { Row } from "./column_map.js"
 * @typedef {{ name: string, label: string, title?: string, text?: boolean, format?: (row: Row) => string }} Field without `format`: the button
 * @typedef {{ rows: Row[], chosen: Map<number, string>, picked: Set<number> | null }} Shown
 */

/**
 *   const table = new ColumnTable(element, fields, { onToggle: (id, event) => {} });
 *   table.show({ rows, chosen, picked });
 *
 * `fields`: [{ name, label, format(row), title }].
 */
export class ColumnTable {
  /**
   * @param {HTMLElement} element
   * @param {Field[]} fields
   * @param {{ onToggle: (id: number, event: MouseEvent) => void, said: HTMLElement }} options
   */
  constructor(element, fields, { onToggle, said }) {
    this.fields = fields;
    this.onToggle = onToggle;
    this.said = said;
    /** @type {Shown} */
    this.shown = { rows: [], chosen: new Map(), picked: null };
    this.order = { name: "column_id", up: true };
    /** @type {Map<number, HTMLElement>} */
    this.lines = new Map();
    this.heads = fields.map((field) => h("th", { scope: "col", class: field.text ? "" : "number", title: field.title },
      h("button", { type: "button", class: "sort", onclick: () => this.sort(field.name) }, field.label)));
    this.body = h("tbody", {});
    element.replaceChildren(h("thead", {}, h("tr", {}, ...this.heads)), this.body);
  }

  /** @param {string} name */
  sort(name) {
    const same = this.order.name === name;
    this.order = { name, up: same ? !this.order.up : name === "column_id" || name === "kind" };
    this.show({});
  }

  /** @param {Partial<Shown>} changes */
  show(changes) {
    const { rows, chosen, picked } = Object.assign(this.shown, changes);
    if (changes.rows || !("chosen" in changes || "picked" in changes)) this.fill();
    for (const [id, line] of this.lines) {
      line.setAttribute("aria-selected", String(chosen.has(id)));
      line.toggleAttribute("data-dim", Boolean(picked && !picked.has(id)));
    }
    setText(this.said, picked ? `${picked.size} of ${several(rows.length, "column")} picked out` : several(rows.length, "column"));
  }

  fill() {
    const { name, up } = this.order;
    const value = (/** @type {Row} */ row) => (typeof row[name] === "string" ? row[name] : row[name] ?? -Infinity);
    const sorted = [...this.shown.rows].sort((a, b) => (value(a) < value(b) ? -1 : value(a) > value(b) ? 1 : a.column_id - b.column_id) * (up ? 1 : -1));
    this.fields.forEach((field, index) => {
      if (field.name === name) this.heads[index].setAttribute("aria-sort", up ? "ascending" : "descending");
      else this.heads[index].removeAttribute("aria-sort");
    });
    this.lines.clear();
    this.body.replaceChildren(...sorted.map((row) => this.line(row)));
  }

  /** @param {Row} row */
  line(row) {
    const toggle = (/** @type {MouseEvent} */ event) => { event.stopPropagation(); this.onToggle(row.column_id, event); };
    const id = h("button", { type: "button", class: "id-button", onclick: toggle, "aria-label": `Column ${row.column_id}: show in time` }, String(row.column_id));
    const cells = this.fields.map((field) => h("td", { class: field.text ? "" : "number" }, field.format ? field.format(row) : id));
    const line = h("tr", { onclick: toggle, dataset: { column: row.column_id } }, ...cells);
    this.lines.set(row.column_id, line);
    return line;
  }
}
