// The column editor: the summed image, the columns on it, the tools, and what is told beside them.

import { get, post, toast, url } from "./api.js";
import { Contrast } from "./contrast.js";
import { at, find, h, setText } from "./dom.js";
import { several, significant } from "./format.js";
import { ImageView } from "./image_view.js";
import { LatticeTool } from "./editor_lattice.js";
import { Model } from "./editor_model.js";
import { FLAGS, isFitted, kindColours, paintColumns, paintOutline, shiftText } from "./editor_paint.js";
import { Refined } from "./editor_refined.js";
import { beginGesture, hit, step, TOOLS } from "./editor_tools.js";
import { Versions } from "./editor_versions.js";

/**
 * @import { Levels } from "./api.js"
 * @import { Column } from "./editor_model.js"
 * @import { Moving } from "./editor_paint.js"
 * @import { Point } from "./image_view.js"
 * @typedef {keyof typeof TOOLS} ToolName
 */

const FEW = 64; // so many columns are moved to the maxima nearby at once
const NEAR = 0.3; // of the spacing: a click this near to a column means it
const SAME = 1 / 3; // of the spacing: columns nearer than this are one
const EDGE_PX = 0.499; // beyond the centre of the outermost pixel
const LATER_MS = 3000;

const isSpace = (event) => event.code === "Space";

export class Editor {
  /**
   * @param {string} job
   * @param {Levels & { shape: [number, number], version: string, pixel_size_pm: number | null }} levels of the sum
   */
  constructor(job, levels) {
    this.job = job;
    this.path = `/jobs/${job}`;
    this.levels = levels;
    this.pixelSizePm = levels.pixel_size_pm;
    this.model = new Model();
    this.colours = kindColours([]);
    /** @type {ToolName} */
    this.tool = "select";
    /** @type {Moving | null} */
    this.moving = null;
    /** @type {Point[] | null} */
    this.outline = null; // that is being drawn
    this.danger = this.spaceDown = false; // it deletes; the view is moved
    /** @type {Column | null} */
    this.hovered = null;
    this.saying = 0;
    this.contrast = new Contrast(at("contrast"), { onChange: () => this.view.reload() });
    this.contrast.setLevels(levels);
    const [height, width] = levels.shape;
    this.view = new ImageView(at("image"), {
      width, height, pixelSizePm: this.pixelSizePm,
      url: ({ x0, y0, x1, y1 }, w) => url(`${this.path}/sum.png`, {
        box: [x0, y0, x1, y1].join(), width: w, v: levels.version, low: this.contrast.value?.[0], high: this.contrast.value?.[1],
      }),
      onDraw: (pen, view) => this.#paint(pen, view),
      onHover: (point) => this.#hover(point),
      onError: (error) => toast(error),
      gesture: (point, event) => beginGesture(this, point, event),
      onDoubleClick: (point) => this.tool !== "select" || hit(this, point) !== null,
    });
    this.lattice = new LatticeTool(this, at("lattice"));
    this.refined = new Refined(this, at("refined"));
    const alone = "alone" in document.body.dataset;
    this.versions = new Versions(this, {
      list: at("version-list"), note: at("note", HTMLInputElement), unsaved: at("unsaved"), alone,
      framed: alone && new URLSearchParams(location.search).has("frame"),
      save: find("[data-do=save]", HTMLButtonElement), goOn: find("[data-do=continue]", HTMLButtonElement),
    });
    this.model.addEventListener("change", () => this.#changed());
    this.model.addEventListener("select", () => this.#selected());
    this.#listen();
    this.choose("select");
  }

  redraw() {
    this.view.redraw();
  }

  /**
   * Take a tool.
   * @param {ToolName} name
   */
  choose(name) {
    if (this.tool === "lattice" && name !== "lattice") this.lattice.restart();
    this.tool = name;
    for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-tool]"))) button.setAttribute("aria-pressed", String(button.dataset.tool === name));
    at("lattice").hidden = name !== "lattice";
    at("image").dataset.tool = name;
    setText(at("hint"), TOOLS[name].hint);
    this.view.element.focus({ preventScroll: true });
    this.redraw();
  }

  /**
   * POST below the job; says what went wrong, and gives null.
   * @param {string} path
   * @param {object} body
   */
  async ask(path, body) {
    try {
      return await post(this.path + path, body);
    } catch (error) {
      toast(error);
      return null;
    }
  }

  get snapping() {
    return at("snap", HTMLInputElement).checked && this.model.spacing !== null;
  }

  /**
   * Move columns to the maxima nearby, where a fit finds them; gives those that it moved.
   * @param {Omit<Column, "flags">[]} columns
   * @returns {Promise<Column[]>}
   */
  async fitted(columns) {
    const rows = columns.map(({ id, x, y, kind }) => ({ column_id: id, x, y, kind }));
    const answer = await this.ask("/columns/refine", { columns: rows, spacing_px: this.model.spacing });
    const byId = new Map(columns.map((column) => [column.id, column]));
    return (answer?.columns ?? []).map(({ column_id: id, x, y, flags }) => ({ ...byId.get(id), x, y, flags }));
  }

  /**
   * The column at a place, or the maximum nearby; null where there is neither.
   * @param {Point} point
   */
  async nearby({ x, y }) {
    const { model } = this;
    const column = model.spacing && model.grid.nearest(x, y, NEAR * model.spacing);
    if (column) return { x: column.x, y: column.y };
    if (!this.snapping || !this.contains({ x, y })) return null;
    const [found] = await this.fitted([{ id: 0, x, y, kind: "" }]);
    return found && !found.flags.includes("outside_frame") ? { x: found.x, y: found.y } : null;
  }

  contains({ x, y }) {
    const { width, height } = this.view;
    return x >= -EDGE_PX && y >= -EDGE_PX && x <= width - 1 + EDGE_PX && y <= height - 1 + EDGE_PX;
  }

  /**
   * Add a column where the user clicked.
   * @param {Point} point
   * @param {boolean} exactly
   */
  async add(point, exactly) {
    const { model } = this;
    if (!this.contains(point)) {
      toast("That is outside the image.");
      return;
    }
    const kind = model.grid.nearest(point.x, point.y, 2 * model.cell)?.kind ?? "";
    const [column] = model.created([{ x: point.x, y: point.y, kind }]);
    const done = model.edit("Add a column", { put: [column] });
    model.select([column.id]);
    if (exactly || !this.snapping) return;
    const [found] = await this.fitted([column]);
    if (!found) return;
    const twin = model.grid.nearest(found.x, found.y, SAME * (model.spacing ?? 0), ({ id }) => id === column.id);
    if (twin && done && model.take(done)) {
      model.select([twin.id]);
      toast(`The maximum there is column ${twin.id} already. Alt-click adds one all the same.`);
    } else if (done) model.amend(done, [found]);
  }

  /** Move what is selected; few columns then go to the maxima nearby. */
  async moveSelected(dx, dy, exactly) {
    const { model, view } = this;
    const columns = model.selected();
    const reach = (/** @type {number[]} */ values, /** @type {number} */ size) => [-EDGE_PX - Math.min(...values), size - 1 + EDGE_PX - Math.max(...values)];
    const [left, right] = reach(columns.map(({ x }) => x), view.width);
    const [up, down] = reach(columns.map(({ y }) => y), view.height);
    const shift = { x: Math.min(right, Math.max(left, dx)), y: Math.min(down, Math.max(up, dy)) };
    const put = columns.map((column) => Object.freeze({ ...column, x: column.x + shift.x, y: column.y + shift.y, flags: [] }));
    const done = model.edit(step("Move", put.length), { put });
    if (done && !exactly && this.snapping && put.length <= FEW) model.amend(done, await this.fitted(put));
  }

  /** @param {number[]} ids */
  remove(ids) {
    if (ids.length) this.model.edit(step("Delete", ids.length), { remove: ids });
  }

  /** @param {string} kind */
  setKind(kind) {
    const put = this.model.selected().filter((column) => column.kind !== kind).map((column) => ({ ...column, kind }));
    if (put.length) this.model.edit(`Make ${several(put.length, "column")} ${kind || "of no kind"}`, { put });
  }

  undo() {
    const undone = this.model.undo();
    if (undone) this.#say(`Undone: ${undone.label}`);
  }

  redo() {
    const redone = this.model.redo();
    if (redone) this.#say(`Done again: ${redone.label}`);
  }

  /** The editor was opened by itself, and the user is done. */
  end() {
    this.view.close();
    find("main").replaceChildren(h("div", { class: "empty" },
      h("h2", {}, "The columns are kept"),
      h("p", {}, `${several(this.model.size, "column")}. You can close this page.`)));
  }

  #say(text) {
    setText(at("hint"), text);
    clearTimeout(this.saying);
    this.saying = setTimeout(() => setText(at("hint"), TOOLS[this.tool].hint), LATER_MS);
  }

  #paint(pen, view) {
    const { model, colours, moving, hovered } = this;
    if (model.version === null) return;
    if (at("show-columns", HTMLInputElement).checked) {
      const refined = this.refined.shown ? this.refined.found : null;
      paintColumns(pen, view, { model, colours, moving, hovered, refined, numbers: at("show-numbers", HTMLInputElement).checked, pixelSizePm: this.pixelSizePm });
    }
    if (this.tool === "lattice") this.lattice.paint(pen, view);
    if (this.outline) paintOutline(pen, view, this.outline, this.danger);
  }

  #hover(point) {
    const hovered = point && hit(this, point);
    if (hovered !== this.hovered) {
      this.hovered = hovered;
      this.redraw();
    }
    this.view.element.toggleAttribute("data-over", Boolean(hovered));
    const inside = point && this.contains(point);
    setText(at("place"), inside ? `x ${point.x.toFixed(1)}  y ${point.y.toFixed(1)} px${hovered ? `  ·  column ${hovered.id}` : ""}` : "");
  }

  #changed() {
    const { model } = this;
    const kinds = model.kinds();
    this.colours = kindColours(kinds.keys());
    setText(at("count"), several(model.size, "column"));
    at("kinds").replaceChildren(...[...kinds.keys()].filter(Boolean).map((value) => h("option", { value })));
    this.#legend(kinds);
    find("[data-do=undo]", HTMLButtonElement).disabled = !model.done.length;
    find("[data-do=redo]", HTMLButtonElement).disabled = !model.undone.length;
    find("[data-do=undo]", HTMLButtonElement).title = `Undo${model.done.length ? `: ${model.done.at(-1)?.label}` : ""} (Ctrl+Z)`;
    if (this.tool === "lattice") this.lattice.changed();
    this.refined.changed();
    this.#selected();
  }

  #legend(kinds) {
    const { model } = this;
    const select = (match) => () => model.select([...model.columns.values()].filter(match).map(({ id }) => id));
    const row = (mark, text, number, match) => h("li", {},
      h("button", { type: "button", title: "Select them", onclick: select(match) }, mark, h("span", {}, text), h("span", { class: "number" }, String(number))));
    const ring = (colour, broken) => h("span", { class: `ring${broken ? " broken" : ""}`, style: { borderColor: colour } });
    const rows = [...kinds].map(([kind, number]) => row(ring(this.colours.get(kind)), kind || "no kind", number, (column) => column.kind === kind));
    for (const [flag, text] of Object.entries(FLAGS)) {
      const number = [...model.columns.values()].filter(({ flags }) => flags.includes(flag)).length;
      const mark = flag === "outside_frame" ? ring("currentColor", true) : h("span", { class: "badge-dot" });
      if (number) rows.push(row(mark, text, number, ({ flags }) => flags.includes(flag)));
    }
    at("legend").replaceChildren(...rows);
  }

  #selected() {
    const { model } = this;
    const columns = model.selected();
    setText(at("selected"), columns.length === 1 ? `Column ${columns[0].id}` : columns.length ? `${several(columns.length, "column")} selected` : "Nothing selected");
    const kinds = new Set(columns.map(({ kind }) => kind));
    for (const control of /** @type {NodeListOf<HTMLInputElement>} */ (at("kind-form").querySelectorAll("input, button"))) control.disabled = !columns.length;
    if (document.activeElement !== at("kind")) at("kind", HTMLInputElement).value = kinds.size === 1 ? [...kinds][0] : "";
    at("kind", HTMLInputElement).placeholder = kinds.size > 1 ? "several kinds" : "sublattice or element";
    find("[data-do=remove]", HTMLButtonElement).disabled = !columns.length;
    at("facts").replaceChildren(...(columns.length === 1 ? this.#facts(columns[0]) : []));
    this.redraw();
  }

  #facts(column) {
    const found = this.refined.found.get(column.id);
    const facts = [["Position", `${significant(column.x, 5)}, ${significant(column.y, 5)} px`]];
    if (this.refined.shown && found && found.of === column && isFitted(found)) facts.push(["Shift of the fit", shiftText(column, found, this.pixelSizePm)]);
    const flags = column.flags.map((flag) => FLAGS[flag]).filter(Boolean);
    if (flags.length) facts.push(["Flags", flags.join(", ")]);
    return facts.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]);
  }

  #listen() {
    for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-tool]"))) button.onclick = () => this.choose(/** @type {ToolName} */ (button.dataset.tool));
    const acts = {
      undo: () => this.undo(), redo: () => this.redo(), remove: () => this.remove([...this.model.selection]),
      fit: () => this.view.fit(), nearer: () => this.view.zoom(1.5), farther: () => this.view.zoom(1 / 1.5),
      all: () => this.model.select(this.model.columns.keys()),
    };
    for (const [name, act] of Object.entries(acts)) {
      find(`[data-do=${name}]`, HTMLButtonElement).onclick = () => {
        act();
        this.view.element.focus({ preventScroll: true });
      };
    }
    at("kind-form").onsubmit = (event) => {
      event.preventDefault();
      this.setKind(at("kind", HTMLInputElement).value.trim());
      this.view.element.focus({ preventScroll: true });
    };
    at("show-columns").onchange = at("show-numbers").onchange = () => this.redraw();
    at("show-refined").onchange = () => this.refined.show(at("show-refined", HTMLInputElement).checked);
    addEventListener("keydown", (event) => this.#key(event));
    addEventListener("keyup", (event) => isSpace(event) && this.#space(false));
    addEventListener("blur", () => this.#space(false));
  }

  #space(down) {
    this.spaceDown = down;
    this.view.element.toggleAttribute("data-grab", down);
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const target = event.target instanceof Element ? event.target : null;
    const typing = target?.closest("input:not([type=checkbox], [type=range]), textarea, select, dialog");
    const command = event.ctrlKey || event.metaKey;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    let act = /** @type {(() => void) | null} */ (null);
    if (command && key === "s") act = () => !find("[data-do=save]", HTMLButtonElement).disabled && this.versions.keep();
    else if (typing || event.altKey) return;
    else if (command) act = { z: () => (event.shiftKey ? this.redo() : this.undo()), y: () => this.redo(), a: () => this.model.select(this.model.columns.keys()) }[key] ?? null;
    else act = this.#plainKey(key, event, target);
    if (!act) return;
    event.preventDefault();
    act();
  }

  /**
   * @param {string} key
   * @param {KeyboardEvent} event
   * @param {Element | null} target
   */
  #plainKey(key, event, target) {
    const tool = /** @type {ToolName[]} */ (Object.keys(TOOLS)).find((name) => TOOLS[name].key === key);
    const toggles = { h: "show-columns", r: "show-refined", n: "show-numbers", s: "snap" };
    if (tool) return () => this.choose(tool);
    if (key in toggles) return () => at(toggles[key]).click();
    if (key === "k") return () => at("kind").focus();
    if (key === "Delete" || key === "Backspace") return () => this.remove([...this.model.selection]);
    if (key === "Escape") return () => this.#escape();
    if (key === "Enter" && this.tool === "lattice" && target === this.view.element) return () => this.lattice.add();
    if (isSpace(event) && !target?.closest("button, a, summary, input")) return () => this.#space(true);
    return null;
  }

  #escape() {
    if (this.tool === "lattice" && this.lattice.back()) return;
    if (this.model.selection.size) this.model.select([]);
    else this.choose("select");
  }
}

/** Open the editor, as soon as there are columns. */
async function start(job) {
  for (;;) {
    try {
      const [levels] = await Promise.all([get(`/jobs/${job}/sum`), get(`/jobs/${job}/columns`)]);
      at("nothing").hidden = true;
      at("editor").hidden = false;
      const opened = new Editor(job, levels);
      await opened.versions.open();
      return opened;
    } catch (error) {
      if (error.status !== 404) {
        at("nothing").replaceChildren(h("h2", {}, error.what || "The columns cannot be shown"), h("p", {}, error.remedy || error.message));
        throw error;
      }
      at("nothing").replaceChildren(h("h2", {}, "No columns yet"),
        h("p", {}, "The job finds them in the sum of its frames. They appear here as soon as it has."),
        h("p", {}, h("a", { class: "button", href: `/jobs/${job}` }, "Watch the job")));
      await new Promise((resolve) => setTimeout(resolve, LATER_MS));
    }
  }
}

export const opened = start(document.body.dataset.job ?? "");
