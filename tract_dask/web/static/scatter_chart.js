// A chart of one number against another: a dot for each thing, which can be told and chosen.

import { h, setText } from "./dom.js";
import { axisOf, boxOf, Chart, clip, paintAxes, places } from "./chart_base.js";
import { dot, stroke } from "./chart_paint.js";
import { extend, padded } from "./chart_scale.js";

/**
 * @import { ChartOptions, Ink, Labels, Places } from "./chart_base.js"
 * @import { Edges, Gappy, Range } from "./chart_scale.js"
 * @typedef {{ x: Range, y: Range }} Bounds
 * @typedef {object} ScatterOptions
 * @property {Gappy} x
 * @property {Gappy} y
 * @property {(index: number) => string} nameOf
 * @property {(index: number) => string} tell
 * @property {number} chosen
 * @property {(index: number) => void} [onPick]
 * @property {Edges} [xRange]
 * @property {Edges} [yRange]
 * @property {boolean} [diagonal]
 * @typedef {Partial<ScatterOptions & ChartOptions & Labels>} ScatterChanges
 */

const DRAG_PX = 5; // a shorter drag is a click
const REACH_PX = 14; // of the pointer
const FULL_TURN = 2 * Math.PI;

/**
 * A chart of dots.
 *
 * @param {HTMLElement} element where it goes; it takes the width, and keeps its height
 * @param {ScatterChanges} options
 *   label: what it shows, for screen readers;  height: px (260)
 *   x, y: one number for each thing; one that has null or NaN in either is left out
 *   nameOf, tell: (index) => text: what a dot is, and what is told of it
 *   chosen: index, or -1;  onPick: (index) => …, after a click or Enter
 *   xLabel, yLabel: with the unit
 *   xRange, yRange: [low, high]; null in it is fitted to the data
 *   diagonal: with the line on which both are equal
 * @returns {ScatterChart} with update(changes), destroy()
 */
export const scatterChart = (element, options) => new ScatterChart(element, options);

/** @extends {Chart<ScatterOptions & ChartOptions & Labels>} */
class ScatterChart extends Chart {
  /**
   * @param {HTMLElement} element
   * @param {ScatterChanges} options
   */
  constructor(element, options) {
    super(element, { height: 260, x: [], y: [], nameOf: String, chosen: -1, tell: () => "", empty: "No data yet", ...options });
    /** @type {Bounds | null} */
    this.view = null; // ranges chosen by the user; null: all
    /** @type {[Range, Range] | null} */
    this.drag = null; // the user's, from corner to corner in px
    this.bounds = /** @type {Bounds} */ ({ x: [0, 1], y: [0, 1] });
    /** @type {Places | null} */
    this.place = null; // once it is painted
    /** @type {number[]} */
    this.dots = [];
    this.over = -1; // under the pointer
    this.sort();
  }

  /**
   * Change any option.
   * @param {ScatterChanges} changes
   */
  update(changes) {
    Object.assign(this.options, changes);
    if (changes.x || changes.y) this.sort();
    this.draw();
  }

  /** Note which dots there are, in the order of their x. */
  sort() {
    const { x, y } = this.options;
    const known = (value) => value !== null && Number.isFinite(value);
    const order = (values, a, b) => values[a] - values[b];
    this.dots = Array.from(x, (_, index) => index).filter((index) => known(x[index]) && known(y[index])).sort((a, b) => order(x, a, b) || order(y, a, b));
  }

  makeLegend() {
    /** @type {HTMLElement} */
    this.name = h("span", { class: "chart-name" });
    /** @type {HTMLElement} */
    this.values = h("b", {});
    this.legend.replaceChildren(this.name, this.values);
  }

  listen() {
    const { canvas } = this;
    /** @type {(event: PointerEvent) => Range} */
    const at = (event) => [event.offsetX, event.offsetY];
    canvas.addEventListener("pointermove", (event) => {
      if (this.drag) this.drag[1] = at(event);
      this.point(this.nearest(...at(event)));
    });
    canvas.addEventListener("pointerleave", () => { if (!this.drag) this.point(-1); });
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !this.place) return;
      canvas.setPointerCapture(event.pointerId);
      this.drag = [at(event), at(event)];
    });
    canvas.addEventListener("pointerup", () => this.drop());
    canvas.addEventListener("pointercancel", () => { this.drag = null; this.draw(); });
    canvas.addEventListener("blur", () => this.point(-1));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  drop() {
    const { drag, place } = this;
    if (!drag || !place) return;
    const [[x0, y0], [x1, y1]] = drag;
    this.drag = null;
    /** @type {(one: number, other: number) => Range} */
    const range = (one, other) => [Math.min(one, other), Math.max(one, other)];
    const [wide, high] = [Math.abs(x1 - x0), Math.abs(y1 - y0)];
    if (wide > DRAG_PX && high > DRAG_PX) this.chooseView({ x: range(place.toX(x0), place.toX(x1)), y: range(place.toY(y0), place.toY(y1)) });
    else if (wide <= DRAG_PX && high <= DRAG_PX) this.pick(this.nearest(x1, y1));
    this.draw();
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    if (!this.place) return;
    const seen = this.seen(), place = seen.indexOf(this.over >= 0 ? this.over : this.options.chosen);
    const to = (index) => this.point(seen[Math.max(0, Math.min(seen.length - 1, index))] ?? -1);
    const around = (factor) => {
      const { x: [x0, x1], y: [y0, y1] } = this.bounds, at = this.over >= 0 ? this.over : this.options.chosen;
      const [x, y] = at >= 0 ? this.spot(at) : [(x0 + x1) / 2, (y0 + y1) / 2];
      this.chooseView({ x: [x - (x - x0) * factor, x + (x1 - x) * factor], y: [y - (y - y0) * factor, y + (y1 - y) * factor] });
    };
    /** @type {Record<string, () => void>} */
    const actions = {
      ArrowLeft: () => to(place - 1), ArrowRight: () => to(place + 1), Home: () => to(0), End: () => to(seen.length - 1),
      "+": () => around(0.5), "-": () => around(2), 0: () => this.chooseView(null), Escape: () => this.point(-1), Enter: () => this.pick(this.over),
    };
    if (!actions[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    actions[event.key]();
  }

  /**
   * What a dot lies at.
   * @param {number} index
   * @returns {Range}
   */
  spot(index) { return [Number(this.options.x[index]), Number(this.options.y[index])]; }

  /** @param {number} index */
  pick(index) { if (index >= 0) this.options.onPick?.(index); }

  /** @param {number} index */
  point(index) {
    this.over = index;
    this.canvas.style.cursor = index >= 0 ? "pointer" : "";
    this.draw();
  }

  /** @param {Bounds | null} view */
  chooseView(view) {
    const all = this.extent();
    /** @type {Bounds | null} */
    const within = view && { x: [Math.max(view.x[0], all.x[0]), Math.min(view.x[1], all.x[1])], y: [Math.max(view.y[0], all.y[0]), Math.min(view.y[1], all.y[1])] };
    const wide = within && ["x", "y"].every((axis) => within[axis][1] - within[axis][0] >= all[axis][1] - all[axis][0]);
    const some = within && ["x", "y"].every((axis) => within[axis][1] > within[axis][0]);
    this.view = some && !wide ? within : null;
    this.whole.hidden = this.view === null;
    this.draw();
  }

  /** The dots inside the axes. */
  seen() {
    const { x: [x0, x1], y: [y0, y1] } = this.bounds;
    return this.dots.filter((index) => {
      const [x, y] = this.spot(index);
      return x >= x0 && x <= x1 && y >= y0 && y <= y1;
    });
  }

  /**
   * The dot under a place in px; -1 where none is near.
   * @param {number} px
   * @param {number} py
   */
  nearest(px, py) {
    if (!this.place) return -1;
    let best = -1, least = REACH_PX ** 2;
    for (const index of this.seen()) {
      const [x, y] = this.spot(index), away = (this.place.x(x) - px) ** 2 + (this.place.y(y) - py) ** 2;
      if (away < least) [best, least] = [index, away];
    }
    return best;
  }

  /**
   * The ranges of the data, or as the options fix them.
   * @returns {Bounds}
   */
  extent() {
    /** @type {(values: Gappy, fixed?: Edges) => Range} */
    const range = (values, [low, high] = [null, null]) => {
      const fitted = padded(extend([Infinity, -Infinity], this.dots.map((index) => values[index])));
      const [from, to] = [low ?? fitted[0], high ?? fitted[1]];
      return to > from ? [from, to] : [from, from + 1];
    };
    return { x: range(this.options.x, this.options.xRange), y: range(this.options.y, this.options.yRange) };
  }

  paint() {
    const found = this.begin();
    if (!found) return;
    const { pen, width, height, ink } = found, { options } = this;
    this.bounds = this.view ?? this.extent();
    const axis = axisOf(pen, this.bounds.y, height), box = boxOf([axis], width, height);
    const place = this.place = places(box, this.bounds.x, this.bounds.y);
    if (!this.dots.length) {
      this.paintEmpty(pen, box, ink);
      this.speak(options.empty);
      return;
    }
    paintAxes(pen, box, [axis], this.bounds.x, ink, options, width, height);
    clip(pen, box);
    if (options.diagonal) this.paintDiagonal(pen, ink, place);
    this.paintDots(pen, ink, place);
    if (this.drag) this.paintDrag(pen, ink, ...this.drag[0], ...this.drag[1]);
    pen.restore();
    const told = this.over >= 0 ? this.over : this.dots.includes(options.chosen) ? options.chosen : -1;
    setText(this.name, told >= 0 ? options.nameOf(told) : "");
    setText(this.values, told >= 0 ? options.tell(told) : "");
    this.speak(`${this.dots.length} dots${told >= 0 ? `; ${options.nameOf(told)}: ${options.tell(told)}` : ""}`);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Ink} ink
   * @param {Places} place
   */
  paintDiagonal(pen, ink, place) {
    const { x: [x0, x1], y: [y0, y1] } = this.bounds, [low, high] = [Math.min(x0, y0), Math.max(x1, y1)];
    pen.setLineDash([5, 4]);
    pen.strokeStyle = ink.text;
    stroke(pen, place.x(low), place.y(low), place.x(high), place.y(high));
    pen.setLineDash([]);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Ink} ink
   * @param {Places} place
   */
  paintDots(pen, ink, place) {
    const { chosen } = this.options, colour = this.colour(1);
    /** @type {(index: number) => Range} */
    const where = (index) => { const [x, y] = this.spot(index); return [place.x(x), place.y(y)]; };
    pen.lineWidth = 1;
    for (const index of this.dots) {
      pen.beginPath();
      pen.arc(...where(index), 4, 0, FULL_TURN);
      pen.globalAlpha = 0.45;
      pen.fillStyle = colour;
      pen.fill();
      pen.globalAlpha = 0.9;
      pen.strokeStyle = colour;
      pen.stroke();
    }
    pen.globalAlpha = 1;
    if (chosen >= 0) dot(pen, ...where(chosen), 5.5, this.colour(2), ink.panel);
    if (this.over < 0) return;
    pen.beginPath();
    pen.arc(...where(this.over), 7.5, 0, FULL_TURN);
    pen.lineWidth = 2;
    pen.strokeStyle = ink.text;
    pen.stroke();
  }
}
