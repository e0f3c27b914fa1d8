// Where the fits in the summed image are: asked for when something has changed, as long as it is shown.

import { post } from "./api.js";
import { h, setText } from "./dom.js";
import { several } from "./format.js";
import { FLAGS, isFitted } from "./editor_paint.js";

/**
 * @import { Editor } from "./editor.js"
 * @import { RefinedColumns } from "./editor_paint.js"
 */

const WAIT_MS = 500; // after a change

export class Refined {
  /**
   * @param {Editor} editor
   * @param {HTMLElement} element
   */
  constructor(editor, element) {
    this.editor = editor;
    this.element = element;
    this.shown = false;
    /** @type {RefinedColumns} */
    this.found = new Map(); // by number of the column
    this.timer = 0;
    /** @type {AbortController | null} */
    this.request = null;
    this.message = h("p", { class: "small" });
    this.problem = h("p", { class: "small problem" });
    this.twins = h("button", { type: "button", class: "link small", onclick: () => this.selectTwins() });
    this.take = h("button", { type: "button", class: "button small", onclick: () => this.takeOver(), title: "Columns without a fit stay where they are" }, "Move columns there");
    element.replaceChildren(this.message, this.twins, this.problem, this.take);
  }

  show(shown) {
    this.shown = shown;
    this.element.hidden = !shown;
    if (shown) this.changed(0);
    else this.request?.abort();
    this.editor.redraw();
  }

  /** The columns have changed. */
  changed(wait = WAIT_MS) {
    if (!this.shown) return;
    clearTimeout(this.timer);
    this.tell();
    this.timer = setTimeout(() => this.ask(), wait);
  }

  /** Learn what the fits say against the columns of a version that was just loaded; tables of versions do not tell. */
  async flags() {
    const { path, model } = this.editor;
    const asked = new Map(model.columns);
    try {
      const { columns } = await post(`${path}/columns/refine`, { columns: model.rows() });
      model.flag(columns.map(({ column_id: id, flags }) => ({ id, flags })), asked);
    } catch { /* they are shown without; asked for by the user, it is told why */ }
  }

  /** Those whose fit is of where they are now. */
  current() {
    const { model } = this.editor;
    return [...this.found].filter(([id, { of }]) => model.columns.get(id) === of);
  }

  /** The fits of those that have one in the image. */
  fitted() {
    return this.current().map(([, found]) => found).filter(isFitted).filter(({ flags }) => !flags.includes("outside_frame"));
  }

  async ask() {
    const { editor } = this;
    const { model } = editor;
    this.request?.abort();
    this.request = null;
    if (!model.size || this.current().length === model.size) {
      this.tell();
      return;
    }
    const request = (this.request = new AbortController());
    const asked = new Map(model.columns);
    setText(this.problem, "");
    this.tell();
    try {
      const answer = await post(`${editor.path}/columns/refine`, { columns: model.rows() }, { signal: request.signal });
      this.found = new Map();
      for (const { column_id: id, x, y, flags } of answer.columns) {
        const of = asked.get(id);
        if (of) this.found.set(id, { of, x, y, flags });
      }
      for (const [first, twin] of answer.merged) {
        const of = asked.get(twin);
        if (of) this.found.set(twin, { of, with: first });
      }
    } catch (error) {
      if (request.signal.aborted) return;
      setText(this.problem, error.what ?? error.message);
    }
    if (this.request === request) this.request = null;
    this.tell();
    editor.redraw();
  }

  tell() {
    const { editor } = this;
    const current = this.current();
    const fitted = this.fitted();
    const twins = current.filter(([, found]) => found.with !== undefined);
    const shifts = fitted.map(({ of, x, y }) => Math.hypot(x - of.x, y - of.y)).sort((one, other) => one - other);
    const length = (px) => (editor.pixelSizePm ? `${(px * editor.pixelSizePm).toFixed(1)} pm` : `${px.toFixed(2)} px`);
    const flagged = Object.entries(FLAGS)
      .map(([flag, text]) => [text, current.filter(([, { flags }]) => flags?.includes(flag)).length])
      .filter(([, number]) => number)
      .map(([text, number]) => `${number} ${text}`);
    const busy = this.request || current.length < editor.model.size;
    setText(this.message, busy ? "Fitting …" : shifts.length
      ? [`Shift: median ${length(shifts[shifts.length >> 1])}, largest ${length(shifts[shifts.length - 1])}`, ...flagged].join(" · ")
      : "No column could be fitted.");
    this.element.toggleAttribute("aria-busy", Boolean(busy));
    this.twins.hidden = !twins.length;
    setText(this.twins, `${several(twins.length, "column falls", "columns fall")} together with another: select`);
    this.take.disabled = Boolean(busy) || !fitted.length;
  }

  selectTwins() {
    this.editor.model.select(this.current().filter(([, found]) => found.with !== undefined).map(([id]) => id));
  }

  /** Move the columns to where their fits are, with what these say of them. */
  takeOver() {
    const put = this.fitted().map(({ of, x, y, flags }) => Object.freeze({ ...of, x, y, flags }));
    this.editor.model.edit(`Move ${several(put.length, "column")} to the refined positions`, { put });
    for (const column of put) this.found.set(column.id, { of: column, x: column.x, y: column.y, flags: column.flags });
    this.tell();
  }
}
