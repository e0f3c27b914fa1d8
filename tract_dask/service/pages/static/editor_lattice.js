// A lattice from three atoms: clicked, adjusted by their handles and by counts, seen before it is added.

import { toast } from "./api.js";
import { find, setText } from "./dom.js";
import { several } from "./format.js";
import { paintLattice } from "./editor_paint.js";

/**
 * @import { Editor } from "./editor.js"
 * @import { ImageView, Point } from "./image_view.js"
 * @typedef {Point & { known: boolean }} Site that is a column already, or not
 * @typedef {{ a_count: number, b_count: number, a_before: number, a_after: number, b_before: number, b_after: number }} Counts
 * @typedef {object} Sites
 * @property {Counts} values
 * @property {number} spacing
 * @property {Site[]} places
 * @property {number} outside
 * @property {number} known
 * @property {number} total
 * @property {number} fresh
 */

const SAME = 1 / 3; // a site within this share of the spacing of a column is that column
const MOST_SITES = 1_000_000;
const MOST_SHOWN = 200_000;
const GRAB_PX = 12;
const STEPS = [
  "Click the origin: any column of the lattice.",
  "Click a column along a row through it, as far away as you can count.",
  "Click a column along another direction.",
];
const COUNTS = ["a_count", "b_count"];
const RANGES = ["a_before", "a_after", "b_before", "b_after"];

export class LatticeTool {
  /**
   * @param {Editor} editor
   * @param {HTMLElement} panel
   */
  constructor(editor, panel) {
    this.editor = editor;
    this.panel = panel;
    /** @type {Point[]} */
    this.handles = []; // the three atoms, as far as they are clicked
    this.touched = [true, false, false]; // whether the user has said how many columns they are apart
    /** @type {Sites | { problem: string } | null} */
    this.sites = null;
    this.fields = Object.fromEntries([...COUNTS, ...RANGES, "kind"].map((name) => [name, find(`[name=${name}]`, HTMLInputElement, panel)]));
    panel.addEventListener("input", (event) => {
      const axis = event.target instanceof HTMLInputElement ? "0ab".indexOf(event.target.name[0]) : -1;
      if (axis > 0) this.touched[axis] = true; // what the user has said is not guessed again
      this.changed();
    });
    panel.addEventListener("submit", (event) => {
      event.preventDefault();
      this.add();
    });
    find("[data-do=fill]", HTMLButtonElement, panel).onclick = () => this.fill();
    find("[data-do=restart]", HTMLButtonElement, panel).onclick = () => this.restart();
    this.restart();
  }

  restart() {
    this.handles = [];
    this.touched = [true, false, false];
    this.changed();
  }

  /** One step back: true where there was one. */
  back() {
    if (!this.handles.length) return false;
    this.handles.pop();
    this.touched[this.handles.length] = false;
    this.changed();
    return true;
  }

  /** @param {Point} point */
  handleAt({ x, y }) {
    const reach = GRAB_PX / this.editor.view.scale;
    const found = this.handles.findLastIndex((handle) => Math.hypot(handle.x - x, handle.y - y) <= reach);
    return found < 0 ? null : found;
  }

  /**
   * The next atom is here, or at the column or maximum nearby.
   * @param {Point} point
   * @param {boolean} exactly
   */
  async click(point, exactly) {
    const index = this.handles.length;
    if (index === 3) return;
    this.handles.push({ x: point.x, y: point.y });
    this.guess(index);
    this.changed();
    await this.snap(index, exactly);
  }

  /**
   * @param {number} index
   * @param {Point} point
   */
  drag(index, { x, y }) {
    this.handles[index] = { x, y };
    this.changed();
  }

  /**
   * @param {number} index
   * @param {boolean} exactly
   */
  async drop(index, exactly) {
    await this.snap(index, exactly);
  }

  /**
   * @param {number} index
   * @param {boolean} exactly
   */
  async snap(index, exactly) {
    const placed = this.handles[index];
    const found = exactly ? null : await this.editor.nearby(placed);
    if (!found || this.handles[index] !== placed) return; // meanwhile moved on
    this.handles[index] = found;
    if (!this.touched[index]) this.guess(index);
    this.changed();
  }

  /**
   * Columns from the origin to an atom: those that are on the line, else by the spacing.
   * @param {number} index
   */
  guess(index) {
    if (!index) return;
    const { model } = this.editor;
    const [origin, atom] = [this.handles[0], this.handles[index]];
    const [dx, dy] = [atom.x - origin.x, atom.y - origin.y];
    const length = Math.hypot(dx, dy);
    const spacing = model.spacing ?? length;
    const near = 0.2 * spacing;
    const [xs, ys] = [[origin.x, atom.x], [origin.y, atom.y]].map((ends) => ends.sort((a, b) => a - b));
    let on = 0;
    model.grid.visit(xs[0] - near, ys[0] - near, xs[1] + near, ys[1] + near, ({ x, y }) => {
      const along = ((x - origin.x) * dx + (y - origin.y) * dy) / length;
      const across = Math.abs((x - origin.x) * dy - (y - origin.y) * dx) / length;
      if (across < near && along > 0.4 * spacing && along < length - 0.4 * spacing) on += 1;
    });
    const count = on ? on + 1 : Math.max(1, Math.round(length / spacing));
    const name = "0ab"[index];
    this.fields[`${name}_count`].value = this.fields[`${name}_after`].value = String(count);
    this.fields[`${name}_before`].value = "0";
  }

  /** @param {string} name */
  value(name) {
    const number = Number(this.fields[name].value);
    const least = COUNTS.includes(name) ? 1 : 0;
    return Number.isInteger(number) && number >= least && number <= 100_000 ? number : null;
  }

  /**
   * The numbers of the fields; null where one is missing or wrong.
   * @returns {Counts | null}
   */
  values() {
    const numbers = Object.fromEntries([...COUNTS, ...RANGES].map((name) => [name, this.value(name)]));
    for (const name of [...COUNTS, ...RANGES]) this.fields[name].setAttribute("aria-invalid", String(numbers[name] === null));
    return Object.values(numbers).includes(null) ? null : /** @type {Counts} */ (/** @type {unknown} */ (numbers));
  }

  /**
   * Steps of the lattice along a and b, px.
   * @param {Counts} values
   * @returns {{ a: Point, b: Point }}
   */
  vectors(values) {
    const [origin, a, b] = this.handles;
    return {
      a: { x: (a.x - origin.x) / values.a_count, y: (a.y - origin.y) / values.a_count },
      b: { x: (b.x - origin.x) / values.b_count, y: (b.y - origin.y) / values.b_count },
    };
  }

  changed() {
    const { panel, handles, editor } = this;
    const complete = handles.length === 3;
    find("[data-part=counts]", undefined, panel).hidden = !complete;
    find("[data-do=restart]", HTMLButtonElement, panel).disabled = !handles.length;
    setText(find("[data-part=step]", undefined, panel), complete ? "" : STEPS[handles.length]);
    find("[data-part=step]", undefined, panel).hidden = complete;
    this.sites = complete ? this.compute() : null;
    if (this.sites) this.tell(this.sites);
    editor.redraw();
  }

  /** @returns {Sites | { problem: string }} */
  compute() {
    const values = this.values();
    if (!values) return { problem: "Counts are whole numbers." };
    const { a, b } = this.vectors(values);
    const cross = Math.abs(a.x * b.y - a.y * b.x);
    if (cross <= 1e-3 * Math.hypot(a.x, a.y) * Math.hypot(b.x, b.y)) return { problem: "The three atoms are on one line." };
    const [rows, columns] = [values.b_before + values.b_after + 1, values.a_before + values.a_after + 1];
    if (rows * columns > MOST_SITES) return { problem: `These are ${several(rows * columns, "site")}; at most ${MOST_SITES} can be laid.` };
    const { model, view } = this.editor;
    const spacing = Math.min(...[a, b, { x: a.x + b.x, y: a.y + b.y }, { x: a.x - b.x, y: a.y - b.y }].map(({ x, y }) => Math.hypot(x, y)));
    const reach = SAME * Math.min(spacing, model.spacing ?? spacing);
    const [origin] = this.handles;
    /** @type {Sites} */
    const found = { values, spacing, places: [], outside: 0, known: 0, total: rows * columns, fresh: 0 };
    for (let j = -values.b_before; j <= values.b_after; j++) {
      for (let i = -values.a_before; i <= values.a_after; i++) {
        const [x, y] = [origin.x + i * a.x + j * b.x, origin.y + i * a.y + j * b.y];
        if (x < -0.5 || y < -0.5 || x >= view.width - 0.5 || y >= view.height - 0.5) {
          found.outside += 1;
          continue;
        }
        const known = model.grid.nearest(x, y, reach) !== null;
        found.known += Number(known);
        if (found.places.length < MOST_SHOWN) found.places.push({ x, y, known });
      }
    }
    found.fresh = found.total - found.outside - found.known;
    return found;
  }

  /** @param {Sites | { problem: string }} sites */
  tell(sites) {
    const { panel } = this, fresh = "fresh" in sites ? sites.fresh : 0;
    const button = find("[type=submit]", HTMLButtonElement, panel);
    button.disabled = !fresh;
    setText(button, fresh ? `Add ${several(fresh, "column")}` : "Nothing to add");
    const parts = "problem" in sites ? [sites.problem] : [
      `${several(sites.total, "site")}, ${sites.spacing.toFixed(1)} px apart`,
      sites.outside && `${sites.outside} outside the image`,
      sites.known && `${sites.known} are columns already (grey)`,
    ].filter(Boolean);
    setText(find("[data-part=told]", undefined, panel), parts.join(" · "));
  }

  /** Repeat it as often as the image needs. */
  fill() {
    const values = this.values();
    if (!values) return;
    const { a, b } = this.vectors(values);
    const { view } = this.editor;
    const [origin] = this.handles;
    const area = a.x * b.y - a.y * b.x;
    if (!area) return;
    const ends = /** @type {Record<string, number[]>} */ ({ a: [], b: [] });
    for (const [x, y] of [[-0.5, -0.5], [view.width - 0.5, -0.5], [-0.5, view.height - 0.5], [view.width - 0.5, view.height - 0.5]]) {
      const [dx, dy] = [x - origin.x, y - origin.y];
      ends.a.push((dx * b.y - dy * b.x) / area);
      ends.b.push((dy * a.x - dx * a.y) / area);
    }
    for (const name of ["a", "b"]) {
      this.fields[`${name}_before`].value = String(Math.max(0, Math.ceil(-Math.min(...ends[name]))));
      this.fields[`${name}_after`].value = String(Math.max(0, Math.ceil(Math.max(...ends[name]))));
    }
    this.changed();
  }

  /**
   * The lattice as the API takes it: its origin is the first site, which may be before the one that was clicked.
   * @param {Counts} values
   */
  request(values) {
    const { a, b } = this.vectors(values);
    const [origin, toA, toB] = this.handles;
    const first = (/** @type {Point} */ name) => ["x", "y"].map((axis) => -values.a_before * a[axis] - values.b_before * b[axis] + name[axis]);
    return {
      origin: first(origin), a: first(toA), b: first(toB), a_count: values.a_count, b_count: values.b_count,
      a_repeats: values.a_before + values.a_after + 1, b_repeats: values.b_before + values.b_after + 1,
      kind: this.fields.kind.value.trim(),
    };
  }

  async add() {
    const { editor, sites } = this;
    if (this.handles.length < 3 || !sites || !("fresh" in sites) || !sites.fresh) return;
    const { model } = editor;
    const beside = [...model.columns.values()].map(({ x, y }) => [x, y]);
    const found = await editor.ask("/columns/lattice", { ...this.request(sites.values), beside });
    if (!found) return;
    const added = model.created(found.columns);
    model.edit(`Add a lattice of ${several(added.length, "column")}`, { put: added });
    model.select(added.map(({ id }) => id));
    const parts = [
      `${several(added.length, "column")} added`,
      found.merged && `${several(found.merged, "site was a column", "sites were columns")} already`,
      found.outside && `${found.outside} outside the image`,
    ].filter(Boolean);
    toast(`${parts.join(", ")}.`, "good");
    this.restart();
    editor.choose("select");
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {ImageView} view
   */
  paint(pen, view) {
    if (!this.handles.length) return;
    const sites = this.sites && "values" in this.sites ? this.sites : null;
    const colour = this.editor.colours.get(this.fields.kind.value.trim()) ?? "#ffd54a";
    const steps = sites && { a: sites.values.a_count, b: sites.values.b_count };
    paintLattice(pen, view, { sites, handles: this.handles, steps, colour });
  }
}
