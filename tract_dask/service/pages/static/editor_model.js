// The columns as they are being edited: a table, a selection, and a history without limit. Knows nothing of the page.
//
// A column is a frozen object {id, x, y, kind, flags}: it is replaced, never changed, so that a step of the history is
// just the columns before and after it.

const DEFAULT_CELL_PX = 32;

/**
 * @import { Point } from "./image_view.js"
 * @typedef {{ readonly id: number, readonly x: number, readonly y: number, readonly kind: string, readonly flags: string[] }} Column
 * @typedef {Map<number, Column | null>} Changes by number; null: it is not there
 * @typedef {{ label: string, before: Changes, after: Changes }} Step
 * @typedef {[id: number, x: number, y: number, kind: string, flags: string[]]} DraftRow
 * @typedef {{ version: number | null, spacing: number | null, nextId: number, columns: DraftRow[] }} Draft
 */

export class Model extends EventTarget {
  constructor() {
    super();
    /** @type {Map<number, Column>} */
    this.columns = new Map();
    /** @type {Set<number>} */
    this.selection = new Set();
    /** @type {number | null} */
    this.spacing = null; // median distance to the nearest neighbour, px
    this.nextId = 1;
    /** @type {number | null} */
    this.version = null; // that these columns come from; null before there are any
    this.grid = new Grid(this.cell);
    /** @type {Step[]} */
    this.done = [];
    /** @type {Step[]} */
    this.undone = [];
    /** @type {Step | null | undefined} */
    this.kept = null; // the step after which the columns were those of the version; null: the first
  }

  /**
   * Take a version; the history begins with it.
   * @param {{ version: number, columns: (Omit<Column, "flags"> & { flags?: string[] })[], spacing: number | null, nextId: number }} table
   */
  load({ version, columns, spacing, nextId }) {
    this.version = version;
    this.spacing = spacing;
    this.nextId = Math.max(nextId, ...columns.map((column) => column.id + 1), 1);
    this.columns = new Map(columns.map((column) => [column.id, Object.freeze({ flags: [], ...column })]));
    this.grid = new Grid(this.cell, this.columns.values());
    this.selection.clear();
    this.#forget();
    this.#tell("change");
  }

  get cell() {
    return Math.max(4, this.spacing ?? DEFAULT_CELL_PX);
  }

  get size() {
    return this.columns.size;
  }

  /** Whether there is something that the version does not have. */
  get dirty() {
    return this.#last() !== this.kept;
  }

  /** What the columns are now, to be told to `saved` once a version of them is kept. */
  mark() {
    return this.#last();
  }

  /**
   * The columns as they were at a mark are kept as a version now.
   * @param {number} version
   * @param {Step | null} mark
   */
  saved(version, mark) {
    this.version = version;
    this.kept = mark;
    this.#tell("change");
  }

  /** The columns in the order of their numbers: the same columns are the same text. */
  rows() {
    return [...this.columns.values()]
      .sort((one, other) => one.id - other.id)
      .map(({ id, x, y, kind }) => ({ column_id: id, x, y, kind }));
  }

  /**
   * Columns with new numbers at {x, y, kind}; they are not in the table yet.
   * @param {{ x: number, y: number, kind?: string, flags?: string[] }[]} places
   */
  created(places) {
    return places.map(({ x, y, kind = "", flags = [] }) => Object.freeze({ id: this.nextId++, x, y, kind, flags }));
  }

  /**
   * One step of the history: columns to put in, or in place of those of the same number, and numbers to take out.
   * `label` says what it did, such as "Delete 3 columns".
   * @param {string} label
   * @param {{ put?: Column[], remove?: number[] }} changes
   */
  edit(label, { put = [], remove = [] }) {
    /** @type {Step} */
    const step = { label, before: new Map(), after: new Map() };
    for (const id of remove) if (this.columns.has(id)) step.after.set(id, null);
    for (const column of put) step.after.set(column.id, Object.freeze(column));
    for (const id of step.after.keys()) step.before.set(id, this.columns.get(id) ?? null);
    if (!step.after.size) return null;
    this.done.push(step);
    this.undone = [];
    this.#apply(step.after);
    return step;
  }

  /**
   * Give a step other columns, as where a place that was clicked turns out to be a little beside the column.
   * @param {Step} step
   * @param {Column[]} columns
   */
  amend(step, columns) {
    if (!this.done.includes(step) || !columns.length) return;
    if (this.kept === step) this.kept = undefined; // it is another step now
    const unchanged = columns.filter(({ id }) => this.columns.get(id) === step.after.get(id)); // since that step
    for (const column of unchanged) step.after.set(column.id, Object.freeze(column));
    this.#apply(new Map(unchanged.map((column) => [column.id, column])));
  }

  /**
   * Take a step back as if it had never been, where it was the last one.
   * @param {Step} step
   */
  take(step) {
    if (this.done.at(-1) !== step) return false;
    this.undo();
    this.undone.pop();
    return true;
  }

  /**
   * Note what the fits say against columns, [{id, flags}], where they are still where these were; no step.
   * @param {{ id: number, flags: string[] }[]} columns
   * @param {Map<number, Column>} asked
   */
  flag(columns, asked) {
    /** @type {Changes} */
    const told = new Map();
    for (const { id, flags } of columns) {
      const column = asked.get(id);
      if (column && this.columns.get(id) === column && flags.length) told.set(id, Object.freeze({ ...column, flags }));
    }
    this.#apply(told);
  }

  undo() {
    const step = this.done.pop();
    if (!step) return null;
    this.undone.push(step);
    this.#apply(step.before);
    return step;
  }

  redo() {
    const step = this.undone.pop();
    if (!step) return null;
    this.done.push(step);
    this.#apply(step.after);
    return step;
  }

  /**
   * @param {Iterable<number>} ids
   * @param {string} how "replace", "add", "toggle" or "subtract"
   */
  select(ids, how = "replace") {
    if (how === "replace") this.selection.clear();
    for (const id of ids) {
      if (how === "toggle" && this.selection.has(id)) this.selection.delete(id);
      else if (how === "subtract") this.selection.delete(id);
      else this.selection.add(id);
    }
    this.#tell("select");
  }

  selected() {
    return [...this.selection].flatMap((id) => this.columns.get(id) ?? []);
  }

  /** The kinds and how many columns have them, in the order of their first column. */
  kinds() {
    /** @type {Map<string, number>} */
    const counts = new Map();
    for (const { kind } of this.columns.values()) counts.set(kind, (counts.get(kind) ?? 0) + 1);
    return counts;
  }

  /**
   * Everything that has to outlive a reload.
   * @returns {Draft}
   */
  draft() {
    return {
      version: this.version, spacing: this.spacing, nextId: this.nextId,
      columns: [...this.columns.values()].map(({ id, x, y, kind, flags }) => [id, x, y, kind, flags]),
    };
  }

  /**
   * Take a draft: its columns are one step after those of its version, which were loaded before.
   * @param {Draft} draft
   */
  restore(draft) {
    const there = new Set(draft.columns.map(([id]) => id));
    const put = draft.columns.map(([id, x, y, kind, flags]) => ({ id, x, y, kind, flags }));
    const changed = put.filter((column) => {
      const old = this.columns.get(column.id);
      return !old || old.x !== column.x || old.y !== column.y || old.kind !== column.kind;
    });
    this.nextId = Math.max(this.nextId, draft.nextId);
    return this.edit("Changes of before", { put: changed, remove: [...this.columns.keys()].filter((id) => !there.has(id)) });
  }

  #forget() {
    this.done = [];
    this.undone = [];
    this.kept = null;
  }

  #last() {
    return this.done.at(-1) ?? null;
  }

  /** @param {Changes} changes */
  #apply(changes) {
    let gone = false;
    for (const [id, column] of changes) {
      const old = this.columns.get(id);
      if (old) this.grid.remove(old);
      if (column) {
        this.columns.set(id, column);
        this.grid.add(column);
      } else {
        this.columns.delete(id);
        gone = this.selection.delete(id) || gone;
      }
    }
    this.#tell("change");
    if (gone) this.#tell("select");
  }

  #tell(kind) {
    this.dispatchEvent(new Event(kind));
  }
}

/** Columns by where they are, in square cells. */
export class Grid {
  /**
   * @param {number} cell its side, px
   * @param {Iterable<Column>} columns
   */
  constructor(cell, columns = []) {
    this.cell = cell;
    /** @type {Map<number, Column[]>} */
    this.cells = new Map();
    for (const column of columns) this.add(column);
  }

  #key(x, y) {
    return Math.floor(x / this.cell) * 0x200000 + Math.floor(y / this.cell);
  }

  /** @param {Column} column */
  add(column) {
    const key = this.#key(column.x, column.y);
    const cell = this.cells.get(key);
    if (cell) cell.push(column);
    else this.cells.set(key, [column]);
  }

  /** @param {Column} column */
  remove({ id, x, y }) {
    const key = this.#key(x, y);
    const left = (this.cells.get(key) ?? []).filter((column) => column.id !== id);
    if (left.length) this.cells.set(key, left);
    else this.cells.delete(key);
  }

  /**
   * Call `each` with the columns in a box, in no order.
   * @param {number} x0
   * @param {number} y0
   * @param {number} x1
   * @param {number} y1
   * @param {(column: Column) => void} each
   */
  visit(x0, y0, x1, y1, each) {
    const look = (/** @type {Column[]} */ cell) => {
      for (const column of cell) if (column.x >= x0 && column.x <= x1 && column.y >= y0 && column.y <= y1) each(column);
    };
    const [left, right, top, bottom] = [x0, x1, y0, y1].map((value) => Math.floor(value / this.cell));
    if ((right - left + 1) * (bottom - top + 1) > this.cells.size) {
      for (const cell of this.cells.values()) look(cell);
      return;
    }
    for (let i = left; i <= right; i++) {
      for (let j = top; j <= bottom; j++) {
        const cell = this.cells.get(i * 0x200000 + j);
        if (cell) look(cell);
      }
    }
  }

  /**
   * @param {number} x0
   * @param {number} y0
   * @param {number} x1
   * @param {number} y1
   */
  inBox(x0, y0, x1, y1) {
    /** @type {Column[]} */
    const found = [];
    this.visit(x0, y0, x1, y1, (column) => found.push(column));
    return found;
  }

  /**
   * The column nearest to a place, no farther away than `reach`; `apart` leaves some out.
   * @param {number} x
   * @param {number} y
   * @param {number} reach
   * @param {(column: Column) => boolean} apart
   */
  nearest(x, y, reach, apart = () => false) {
    let best = /** @type {Column | null} */ (null), least = reach;
    this.visit(x - reach, y - reach, x + reach, y + reach, (column) => {
      const distance = Math.hypot(column.x - x, column.y - y);
      if (distance <= least && !apart(column)) [best, least] = [column, distance];
    });
    return best;
  }

  /**
   * The columns inside a closed line of [{x, y}], by the even-odd rule.
   * @param {Point[]} line
   */
  inside(line) {
    const [xs, ys] = [line.map(({ x }) => x), line.map(({ y }) => y)];
    const bounds = [xs, ys].map((values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))]);
    const [[x0, x1], [y0, y1]] = bounds;
    return this.inBox(x0, y0, x1, y1).filter((column) => contains(line, column));
  }
}

/**
 * Whether a place is inside a closed line of [{x, y}], by the even-odd rule.
 * @param {Point[]} line
 * @param {Point} place
 */
export function contains(line, { x, y }) {
  let inside = false;
  for (let i = 0, j = line.length - 1; i < line.length; j = i++) {
    const [a, b] = [line[i], line[j]];
    if (a.y > y !== b.y > y && x < a.x + ((y - a.y) / (b.y - a.y)) * (b.x - a.x)) inside = !inside;
  }
  return inside;
}
