// Charts of what changes in time and of how it is spread, drawn on a canvas in the colours of the style sheet.
// Why not a library: docs/decisions.md.

import { h, setText } from "./dom.js";
import { significant } from "./format.js";
import { axisOf, boxOf, Chart, clip, paintAxes, places } from "./chart_base.js";
import { dot, paintSeries, stroke } from "./chart_paint.js";
import { extend, firstNotBelow, nearest, padded } from "./chart_scale.js";

/**
 * @import { ChartOptions, Ink, Inside, Labels, Places } from "./chart_base.js"
 * @import { Series } from "./chart_paint.js"
 * @import { Edges, Range } from "./chart_scale.js"
 * @typedef {object} LineOptions
 * @property {Series[]} series
 * @property {Edges} [xRange]
 * @property {Edges} [yRange]
 * @property {Edges} [rightRange]
 * @property {(value: number) => string} formatX
 * @property {(value: number) => string} formatY
 * @property {{ x: number, label?: string }[]} markers
 * @property {number[]} levels
 * @property {string} [group]
 * @property {(range: Range | null) => void} [onRange]
 * @property {(x: number) => void} [onPick]
 * @typedef {Partial<LineOptions & ChartOptions & Labels>} LineChanges
 * @typedef {{ x: number, y: number | null, low?: number | null, high?: number | null, text?: string }} Found under the pointer
 */

const DRAG_PX = 5; // a shorter drag is a click

/**
 * A chart of lines, bands, points or bars over a common x.
 *
 * @param {HTMLElement} element where it goes; it takes the width, and keeps its height
 * @param {LineChanges} options
 *   label: what it shows, for screen readers;  height: px (200)
 *   series: [{ name, x, y, low, high, color, kind, right, unit, dashed, gaps }]: `x` ascending; null and NaN are gaps;
 *     `low`, `high` a band; `color` 1 to 6 (a series variable of theme.css) or a CSS colour; `kind` "line", "area", "points",
 *     "dots" (line and points), "bars" (`x` holds one edge more than `y`), "band" (no line); `right` the right-hand axis;
 *     with `gaps` a line ends before a step of `x` that is half as long again as the usual one
 *   xLabel, yLabel, rightLabel: with the unit
 *   xRange, yRange, rightRange: [low, high]; null in it is fitted to the data
 *   formatX, formatY: (number) => text, for what is under the pointer
 *   markers: [{ x, label }]: dashed uprights, named above (leave yLabel empty then);  levels: [y]: dashed lines across
 *   empty: text while there are no data
 *   group: charts of one group share the pointer's x and the zoom
 *   onRange: ([x0, x1] | null) => …, after a zoom by the user;  onPick: (x) => …, after a click
 * @returns {LineChart} with update(changes), zoom(range | null), destroy()
 */
export const lineChart = (element, options) => new LineChart(element, options);

/**
 * A histogram: `edges` one more than `counts`. Further options as of lineChart.
 * @param {HTMLElement} element
 * @param {{ edges: number[], counts: number[], name?: string, color?: number } & LineChanges} options
 */
export function histogram(element, { edges, counts, name = "", color = 1, ...options }) {
  const bars = (e, c) => [{ name, x: e, y: c, color, kind: "bars" }];
  const chart = lineChart(element, { yRange: [0, null], ...options, series: bars(edges, counts) });
  return {
    /** @param {LineChanges & { edges?: number[], counts?: number[] }} changes */
    update: (changes) => chart.update({ ...changes, ...(changes.edges && changes.counts ? { series: bars(changes.edges, changes.counts) } : {}) }),
    destroy: () => chart.destroy(),
  };
}

/** @type {Map<string, Set<LineChart>>} */
const groups = new Map();

/** @extends {Chart<LineOptions & ChartOptions & Labels>} */
class LineChart extends Chart {
  /**
   * @param {HTMLElement} element
   * @param {LineChanges} options
   */
  constructor(element, options) {
    super(element, { height: 200, series: [], markers: [], levels: [], empty: "No data yet", formatY: (value) => significant(value, 4), formatX: (value) => significant(value, 5), ...options });
    /** @type {Range | null} */
    this.view = null; // x range chosen by the user; null: all
    /** @type {number | null} */
    this.pointer = null; // x under the pointer
    /** @type {Range | null} */
    this.drag = null; // the user's, in px
    if (options.group) groups.set(options.group, (groups.get(options.group) ?? new Set()).add(this));
  }

  /**
   * Change any option; the view stays where the user has put it.
   * @param {LineChanges} changes
   */
  update(changes) {
    const names = this.names();
    Object.assign(this.options, changes);
    if (names !== this.names()) this.makeLegend();
    this.draw();
  }

  /**
   * Show the x range; null shows all.
   * @param {Range | null} range
   */
  zoom(range) {
    this.view = range;
    this.whole.hidden = range === null;
    this.draw();
  }

  destroy() {
    groups.get(this.options.group ?? "")?.delete(this);
    super.destroy();
  }

  names() { return this.options.series.map((one) => `${one.name}${one.color}`).join("|"); }

  makeLegend() {
    const many = this.options.series.length > 1;
    /** @type {HTMLElement[]} */
    this.values = this.options.series.map(() => h("b", {}));
    /** @type {HTMLElement} */
    this.at = h("span", { class: "chart-at" });
    this.legend.replaceChildren(...this.options.series.map((one, index) =>
      h("span", { class: "chart-name" }, many && h("span", { class: `chart-key${one.kind === "band" ? " band" : ""}`, style: { background: this.colourOf(one, index) } }), one.name ?? "", " ", this.values[index])), this.at);
  }

  /**
   * @param {Series} one
   * @param {number} index
   */
  colourOf(one, index) { return this.colour(one.color ?? index + 1); }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointermove", (event) => {
      if (this.drag) this.drag[1] = event.offsetX;
      this.point(this.toX?.(event.offsetX) ?? null);
    });
    canvas.addEventListener("pointerleave", () => { if (!this.drag) this.point(null); });
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || !this.toX) return;
      canvas.setPointerCapture(event.pointerId);
      this.drag = [event.offsetX, event.offsetX];
    });
    canvas.addEventListener("pointerup", () => this.drop());
    canvas.addEventListener("pointercancel", () => { this.drag = null; this.draw(); });
    canvas.addEventListener("blur", () => this.point(null));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  drop() {
    if (!this.drag || !this.toX) return;
    const [from, to] = [this.toX(this.drag[0]), this.toX(this.drag[1])];
    const moved = Math.abs(this.drag[1] - this.drag[0]) > DRAG_PX;
    this.drag = null;
    if (moved) this.chooseView([Math.min(from, to), Math.max(from, to)]);
    else this.options.onPick?.(to);
    this.draw();
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const longest = this.options.series.reduce((best, one) => (one.x.length > best.length ? one.x : best), /** @type {ArrayLike<number>} */ ([]));
    if (!longest.length || !this.bounds) return;
    const [x0, x1] = this.bounds;
    const index = this.pointer === null ? firstNotBelow(longest, x0) : nearest(longest, this.pointer);
    const to = (i) => this.point(longest[Math.max(0, Math.min(longest.length - 1, i))]);
    const middle = this.pointer ?? (x0 + x1) / 2;
    const around = (factor) => this.chooseView([middle - (middle - x0) * factor, middle + (x1 - middle) * factor]);
    /** @type {Record<string, () => void>} */
    const actions = {
      ArrowLeft: () => to(index - 1), ArrowRight: () => to(this.pointer === null ? index : index + 1),
      Home: () => to(0), End: () => to(longest.length - 1),
      "+": () => around(0.5), "-": () => around(2), 0: () => this.chooseView(null), Escape: () => this.point(null),
      Enter: () => this.pointer !== null && this.options.onPick?.(this.pointer),
    };
    if (!actions[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    actions[event.key]();
  }

  peers() { return groups.get(this.options.group ?? "") ?? [this]; }

  /** @param {number | null} x */
  point(x) {
    for (const chart of this.peers()) { chart.pointer = x; chart.draw(); }
  }

  /** @param {Range | null} range */
  chooseView(range) {
    const all = this.extent();
    let view = range && /** @type {Range} */ ([Math.max(range[0], all[0]), Math.min(range[1], all[1])]);
    if (view && (view[1] - view[0] >= all[1] - all[0] || !(view[1] > view[0]))) view = null;
    for (const chart of this.peers()) chart.zoom(view);
    this.options.onRange?.(view);
  }

  /**
   * The x range of the data, or as the options fix it.
   * @returns {Range}
   */
  extent() {
    /** @type {Range} */
    const range = [Infinity, -Infinity];
    for (const one of this.options.series) if (one.x.length) extend(range, [one.x[0], one.x[one.x.length - 1]]);
    const [low, high] = this.options.xRange ?? [];
    if (!(range[0] <= range[1])) return [low ?? 0, high ?? 1];
    const wide = range[0] === range[1] ? [range[0] - 0.5, range[1] + 0.5] : range;
    return [low ?? wide[0], high ?? wide[1]];
  }

  /**
   * The y range of one axis over the x that is seen.
   * @param {boolean} right
   * @param {Range} seen
   * @returns {Range}
   */
  rangeY(right, [x0, x1]) {
    /** @type {Range} */
    const range = [Infinity, -Infinity];
    for (const one of this.options.series.filter((s) => Boolean(s.right) === right)) {
      const start = Math.max(0, firstNotBelow(one.x, x0) - 1), stop = firstNotBelow(one.x, x1) + 1;
      for (const values of [one.y, one.low, one.high]) if (values) extend(range, Array.prototype.slice.call(values, start, stop));
    }
    const fixed = (right ? this.options.rightRange : this.options.yRange) ?? [];
    const fitted = padded(range);
    const [low, high] = [fixed[0] ?? fitted[0], fixed[1] ?? fitted[1]];
    return high > low ? [low, high] : [low, low + 1];
  }

  paint() {
    const found = this.begin();
    if (!found) return;
    const { pen, width, height, ink } = found, { options } = this, bounds = this.view ?? this.extent();
    /** @type {Range | undefined} */
    this.bounds = bounds;
    const hasData = options.series.some((one) => one.y.length);
    const hasRight = options.series.some((one) => one.right);
    const axes = [false, ...(hasRight ? [true] : [])].map((right) => axisOf(pen, this.rangeY(right, bounds), height));
    const top = options.yLabel || options.rightLabel || options.markers.length ? 24 : 10;
    const box = boxOf(axes, width, height, top), place = axes.map((axis) => places(box, bounds, axis.range));
    /** @type {((px: number) => number) | undefined} */
    this.toX = place[0].toX;
    if (hasData) paintAxes(pen, box, axes, bounds, ink, options, width, height);
    clip(pen, box);
    if (hasData) this.paintLevels(pen, box, place[0], ink);
    options.series.forEach((one, index) => paintSeries(pen, one, this.colourOf(one, index), bounds, place[one.right ? 1 : 0], box));
    if (this.drag) this.paintDrag(pen, ink, this.drag[0], box.top, this.drag[1], box.bottom);
    pen.restore();
    this.paintMarkers(pen, box, bounds, place[0], ink);
    if (hasData) this.paintPointer(pen, box, bounds, place, ink);
    else this.paintEmpty(pen, box, ink);
    this.speak(hasData ? this.summary() : options.empty);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Inside} box
   * @param {Places} place
   * @param {Ink} ink
   */
  paintLevels(pen, box, place, ink) {
    pen.setLineDash([5, 4]);
    pen.strokeStyle = ink.text;
    for (const y of this.options.levels) stroke(pen, box.left, Math.round(place.y(y)) + 0.5, box.right, Math.round(place.y(y)) + 0.5);
    pen.setLineDash([]);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Inside} box
   * @param {Range} bounds
   * @param {Places} place
   * @param {Ink} ink
   */
  paintMarkers(pen, box, bounds, place, ink) {
    pen.setLineDash([3, 3]);
    for (const { x, label } of this.options.markers) {
      if (x < bounds[0] || x > bounds[1]) continue;
      const at = Math.round(place.x(x)) + 0.5;
      pen.strokeStyle = ink.text;
      stroke(pen, at, box.top, at, box.bottom);
      if (!label) continue;
      pen.fillStyle = ink.text;
      pen.textAlign = at > box.right - 60 ? "right" : "left";
      pen.fillText(label, at + (pen.textAlign === "left" ? 3 : -3), box.top - 9);
    }
    pen.setLineDash([]);
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Inside} box
   * @param {Range} bounds
   * @param {Places[]} place
   * @param {Ink} ink
   */
  paintPointer(pen, box, bounds, place, ink) {
    const { series, formatX } = this.options, { pointer } = this;
    let at = /** @type {Found | null} */ (null);
    for (const [index, one] of series.entries()) {
      const found = pointer !== null && pointer >= bounds[0] && pointer <= bounds[1] ? valueAt(one, pointer) : null;
      if (!found || found.y === null || !Number.isFinite(found.y)) { setText(this.values[index], ""); continue; }
      setText(this.values[index], this.valueText(one, found));
      at ??= found;
      if (one.kind === "bars" || one.kind === "band") continue;
      const own = place[one.right ? 1 : 0];
      dot(pen, own.x(found.x), own.y(found.y), 3.5, this.colourOf(one, index), ink.panel);
    }
    setText(this.at, at ? `at ${at.text ?? formatX(at.x)}` : "");
    if (!at) return;
    pen.strokeStyle = ink.text;
    pen.globalAlpha = 0.5;
    const x = Math.round(place[0].x(at.x)) + 0.5;
    stroke(pen, x, box.top, x, box.bottom);
    pen.globalAlpha = 1;
  }

  /**
   * @param {Series} one
   * @param {Found} found
   */
  valueText(one, { y, low, high }) {
    const formatY = /** @type {(value: unknown) => string} */ (this.options.formatY);
    return `${one.kind === "band" ? `${formatY(low)} to ${formatY(high)}` : formatY(y)}${one.unit ? ` ${one.unit}` : ""}`;
  }

  summary() {
    const { series, formatY } = this.options;
    const parts = series.map((one) => {
      const range = extend([Infinity, -Infinity], one.y);
      return range[0] <= range[1] ? `${one.name ?? ""} from ${formatY(range[0])} to ${formatY(range[1])}` : "";
    });
    return parts.filter(Boolean).join("; ");
  }
}

/**
 * @param {Series} one
 * @param {number} x
 * @returns {Found | null}
 */
function valueAt(one, x) {
  if (!one.y.length) return null;
  if (one.kind !== "bars") {
    const index = nearest(one.x, x);
    return { x: one.x[index], y: one.y[index], low: one.low?.[index], high: one.high?.[index] };
  }
  const index = Math.min(Math.max(firstNotBelow(one.x, x) - 1, 0), one.y.length - 1);
  return { x, y: one.y[index], text: `${significant(one.x[index], 3)} to ${significant(one.x[index + 1], 3)}` };
}
