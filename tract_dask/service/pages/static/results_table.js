// The columns as a table that can be sorted; a click on a row shows the column in time.

import { h, setText } from "/static/dom.js";
import { several } from "/static/format.js";

/**
 *   const table = new ColumnTable(element, fields, { onToggle: (id, event) => {} });
 *   table.show({ rows, chosen, picked });
 *
 * `fields`: [{ name, label, format(row), title }].
 */
export class ColumnTable {
  constructor(element, fields, { onToggle, said }) {
    Object.assign(this, { element, fields, onToggle, said, rows: [], chosen: new Map(), picked: null, order: { name: "column_id", up: true } });
    this.lines = new Map();
    this.heads = fields.map((field) => h("th", { scope: "col", class: field.text ? "" : "number", title: field.title },
      h("button", { type: "button", class: "sort", onclick: () => this.sort(field.name) }, field.label)));
    this.body = h("tbody", {});
    element.replaceChildren(h("thead", {}, h("tr", {}, ...this.heads)), this.body);
  }

  sort(name) {
    const same = this.order.name === name;
    this.order = { name, up: same ? !this.order.up : name === "column_id" || name === "kind" };
    this.show({});
  }

  show(changes) {
    Object.assign(this, changes);
    if (changes.rows || !("chosen" in changes || "picked" in changes)) this.fill();
    for (const [id, line] of this.lines) {
      line.setAttribute("aria-selected", String(this.chosen.has(id)));
      line.toggleAttribute("data-dim", Boolean(this.picked && !this.picked.has(id)));
    }
    setText(this.said, this.picked ? `${this.picked.size} of ${several(this.rows.length, "column")} picked out` : several(this.rows.length, "column"));
  }

  fill() {
    const { name, up } = this.order;
    const value = (row) => (typeof row[name] === "string" ? row[name] : row[name] ?? -Infinity);
    const sorted = [...this.rows].sort((a, b) => (value(a) < value(b) ? -1 : value(a) > value(b) ? 1 : a.column_id - b.column_id) * (up ? 1 : -1));
    this.fields.forEach((field, index) => {
      if (field.name === name) this.heads[index].setAttribute("aria-sort", up ? "ascending" : "descending");
      else this.heads[index].removeAttribute("aria-sort");
    });
    this.lines.clear();
    this.body.replaceChildren(...sorted.map((row) => this.line(row)));
  }

  line(row) {
    const toggle = (event) => { event.stopPropagation(); this.onToggle(row.column_id, event); };
    const id = h("button", { type: "button", class: "id-button", onclick: toggle, "aria-label": `Column ${row.column_id}: show in time` }, String(row.column_id));
    const cells = this.fields.map((field) => h("td", { class: field.text ? "" : "number" }, field.name === "column_id" ? id : field.format(row)));
    const line = h("tr", { onclick: toggle, dataset: { column: row.column_id } }, ...cells);
    this.lines.set(row.column_id, line);
    return line;
  }
}
