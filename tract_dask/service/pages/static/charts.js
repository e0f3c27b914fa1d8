// Charts of what changes in time and of how it is spread, drawn on a canvas in the colours of the style sheet.
// Why not BokehJS: docs/decisions.md. A chart is redrawn whole, at most once a frame of the screen.

import { theme } from "./api.js";
import { h, setText } from "./dom.js";
import { significant } from "./format.js";
import { dot, paintSeries, stroke } from "./chart_paint.js";
import { extend, firstNotBelow, nearest, padded, tickText, ticks } from "./chart_scale.js";

const FONT = '11.5px system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif';
const DRAG_PX = 5; // a shorter drag is a click

/**
 * A chart of lines, bands, points or bars over a common x.
 *
 * @param {HTMLElement} element where it goes; it takes the width, and keeps its height
 * @param {object} options
 *   label: what it shows, for screen readers;  height: px (200)
 *   series: [{ name, x, y, low, high, color, kind, right, unit, dashed }]: `x` ascending; null and NaN are gaps;
 *     `low`, `high` a band; `color` 1 to 6 (a series variable of style.css) or a CSS colour; `kind` "line", "area", "points", "dots" (line and
 *     points), "bars" (`x` holds one edge more than `y`); `right` the right-hand axis
 *   xLabel, yLabel, rightLabel: with the unit
 *   xRange, yRange, rightRange: [low, high]; null in it is fitted to the data
 *   formatX, formatY: (number) => text, for what is under the pointer
 *   markers: [{ x, label }]: dashed uprights, named above (leave yLabel empty then)
 *   empty: text while there are no data
 *   group: charts of one group share the pointer's x and the zoom
 *   onRange: ([x0, x1] | null) => …, after a zoom by the user;  onPick: (x) => …, after a click
 * @returns {LineChart} with update(changes), zoom(range | null), destroy()
 */
export const lineChart = (element, options) => new LineChart(element, options);

/** A histogram: `edges` one more than `counts`. Further options as of lineChart. */
export function histogram(element, { edges, counts, name = "", color = 1, ...options }) {
  const bars = (e, c) => [{ name, x: e, y: c, color, kind: "bars" }];
  const chart = lineChart(element, { yRange: [0, null], ...options, series: bars(edges, counts) });
  return {
    update: (changes) => chart.update({ ...changes, ...(changes.edges ? { series: bars(changes.edges, changes.counts) } : {}) }),
    destroy: () => chart.destroy(),
  };
}

const groups = new Map();

class LineChart {
  constructor(element, options) {
    this.options = { height: 200, series: [], markers: [], empty: "No data yet", formatY: (value) => significant(value, 4), formatX: (value) => significant(value, 5), ...options };
    this.view = null; // x range chosen by the user; null: all
    this.pointer = null; // x under the pointer
    this.drag = null; // [from, to] in px
    this.frame = 0;
    this.legend = h("div", { class: "chart-legend" });
    this.canvas = h("canvas", { tabindex: 0, role: "img", style: { height: `${this.options.height}px` } });
    this.whole = h("button", { type: "button", class: "button small chart-whole", hidden: true, onclick: () => this.chooseView(null) }, "Whole range");
    element.classList.add("chart");
    element.replaceChildren(this.legend, this.canvas, this.whole);
    this.element = element;
    this.sizes = new ResizeObserver(() => this.draw());
    this.sizes.observe(this.canvas);
    this.stopTheme = theme.onChange(() => { this.makeLegend(); this.draw(); });
    this.listen();
    if (options.group) groups.set(options.group, (groups.get(options.group) ?? new Set()).add(this));
    this.makeLegend();
    this.draw();
  }

  /** Change any option; the view stays where the user has put it. */
  update(changes) {
    const names = this.names();
    Object.assign(this.options, changes);
    if (names !== this.names()) this.makeLegend();
    this.draw();
  }

  /** Show the x range; null shows all. */
  zoom(range) {
    this.view = range;
    this.whole.hidden = range === null;
    this.draw();
  }

  destroy() {
    this.sizes.disconnect();
    this.stopTheme();
    cancelAnimationFrame(this.frame);
    groups.get(this.options.group)?.delete(this);
    this.element.replaceChildren();
  }

  names() { return this.options.series.map((one) => `${one.name}${one.color}`).join("|"); }

  makeLegend() {
    const many = this.options.series.length > 1;
    this.values = this.options.series.map(() => h("b", {}));
    this.at = h("span", { class: "chart-at" });
    this.legend.replaceChildren(...this.options.series.map((one, index) =>
      h("span", { class: "chart-name" }, many && h("span", { class: "chart-key", style: { background: this.colour(one, index) } }), one.name ?? "", " ", this.values[index])), this.at);
  }

  colour(one, index) {
    const color = one.color ?? index + 1;
    return typeof color === "number" ? theme.color(`--series-${color}`) : color.startsWith("--") ? theme.color(color) : color;
  }

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
    canvas.addEventListener("dblclick", () => this.chooseView(null));
    canvas.addEventListener("blur", () => this.point(null));
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  drop() {
    if (!this.drag) return;
    const [from, to] = this.drag.map((px) => this.toX(px));
    const moved = Math.abs(this.drag[1] - this.drag[0]) > DRAG_PX;
    this.drag = null;
    if (moved) this.chooseView([Math.min(from, to), Math.max(from, to)]);
    else this.options.onPick?.(to);
    this.draw();
  }

  key(event) {
    const longest = this.options.series.reduce((best, one) => (one.x.length > best.length ? one.x : best), []);
    if (!longest.length || !this.bounds) return;
    const [x0, x1] = this.bounds;
    const index = this.pointer === null ? firstNotBelow(longest, x0) : nearest(longest, this.pointer);
    const to = (i) => this.point(longest[Math.max(0, Math.min(longest.length - 1, i))]);
    const middle = this.pointer ?? (x0 + x1) / 2;
    const around = (factor) => this.chooseView([middle - (middle - x0) * factor, middle + (x1 - middle) * factor]);
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

  peers() { return groups.get(this.options.group) ?? [this]; }

  point(x) {
    for (const chart of this.peers()) { chart.pointer = x; chart.draw(); }
  }

  chooseView(range) {
    const all = this.extent();
    let view = range && [Math.max(range[0], all[0]), Math.min(range[1], all[1])];
    if (view && (view[1] - view[0] >= all[1] - all[0] || !(view[1] > view[0]))) view = null;
    for (const chart of this.peers()) chart.zoom(view);
    this.options.onRange?.(view);
  }

  /** The x range of the data, or as the options fix it. */
  extent() {
    const range = [Infinity, -Infinity];
    for (const one of this.options.series) if (one.x.length) extend(range, [one.x[0], one.x[one.x.length - 1]]);
    const [low, high] = this.options.xRange ?? [];
    if (!(range[0] <= range[1])) return [low ?? 0, high ?? 1];
    const wide = range[0] === range[1] ? [range[0] - 0.5, range[1] + 0.5] : range;
    return [low ?? wide[0], high ?? wide[1]];
  }

  /** The y range of one axis over the x that is seen. */
  rangeY(right, [x0, x1]) {
    const range = [Infinity, -Infinity];
    for (const one of this.options.series.filter((s) => Boolean(s.right) === right)) {
      const start = Math.max(0, firstNotBelow(one.x, x0) - 1), stop = firstNotBelow(one.x, x1) + 1;
      for (const values of [one.y, one.low, one.high]) if (values) extend(range, values.slice(start, stop));
    }
    const fixed = (right ? this.options.rightRange : this.options.yRange) ?? [];
    const fitted = padded(range);
    const [low, high] = [fixed[0] ?? fitted[0], fixed[1] ?? fitted[1]];
    return high > low ? [low, high] : [low, low + 1];
  }

  draw() {
    if (!this.frame) this.frame = requestAnimationFrame(() => { this.frame = 0; this.paint(); });
  }

  paint() {
    const width = this.canvas.clientWidth, height = this.options.height;
    if (!width) return;
    const ratio = devicePixelRatio || 1;
    const [pixelsX, pixelsY] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== pixelsX || this.canvas.height !== pixelsY) Object.assign(this.canvas, { width: pixelsX, height: pixelsY });
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = FONT;
    const ink = { text: theme.color("--muted"), line: theme.color("--line"), strong: theme.color("--text"), panel: theme.color("--panel"), accent: theme.color("--accent") };
    this.bounds = this.view ?? this.extent();
    const hasData = this.options.series.some((one) => one.y.length);
    const hasRight = this.options.series.some((one) => one.right);
    const axes = [this.axis(pen, false, height), hasRight ? this.axis(pen, true, height) : null];
    const box = { left: axes[0].room, right: width - (axes[1] ? axes[1].room : 10), top: 24, bottom: height - 32 };
    this.toX = (px) => this.bounds[0] + ((px - box.left) / (box.right - box.left)) * (this.bounds[1] - this.bounds[0]);
    const place = { x: (x) => box.left + ((x - this.bounds[0]) / (this.bounds[1] - this.bounds[0])) * (box.right - box.left) };
    if (hasData) this.paintAxes(pen, box, axes, place, ink, width, height);
    pen.save();
    pen.beginPath();
    pen.rect(box.left, box.top - 2, box.right - box.left, box.bottom - box.top + 4);
    pen.clip();
    this.options.series.forEach((one, index) => {
      const [low, high] = axes[one.right ? 1 : 0].range;
      place.y = (y) => box.bottom - ((y - low) / (high - low)) * (box.bottom - box.top);
      paintSeries(pen, one, this.colour(one, index), this.bounds, place, box);
    });
    if (this.drag) {
      pen.globalAlpha = 0.18;
      pen.fillStyle = ink.accent;
      pen.fillRect(Math.min(...this.drag), box.top, Math.abs(this.drag[1] - this.drag[0]), box.bottom - box.top);
      pen.globalAlpha = 1;
    }
    pen.restore();
    this.paintMarkers(pen, box, place, ink);
    if (hasData) this.paintPointer(pen, box, axes, place, ink);
    else {
      pen.fillStyle = ink.text;
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(this.options.empty, (box.left + box.right) / 2, (box.top + box.bottom) / 2);
    }
    this.canvas.setAttribute("aria-label", this.spoken(hasData));
  }

  axis(pen, right, height) {
    const range = this.rangeY(right, this.bounds);
    const wanted = Math.max(2, Math.round((height - 52) / 38));
    const few = ticks(...range, wanted);
    const { values, step } = few.values.length > 1 ? few : ticks(...range, 2 * wanted); // one number is no scale
    const texts = values.map((value) => tickText(value, step));
    return { range, values, texts, room: Math.max(28, ...texts.map((text) => pen.measureText(text).width)) + 10 };
  }

  paintAxes(pen, box, axes, place, ink, width, height) {
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    axes.forEach((axis, side) => {
      if (!axis) return;
      pen.textAlign = side ? "left" : "right";
      const [low, high] = axis.range;
      axis.values.forEach((value, index) => {
        const y = Math.round(box.bottom - ((value - low) / (high - low)) * (box.bottom - box.top)) + 0.5;
        pen.strokeStyle = ink.line;
        if (!side) stroke(pen, box.left, y, box.right, y);
        pen.fillStyle = ink.text;
        pen.fillText(axis.texts[index], side ? box.right + 7 : box.left - 7, y);
      });
    });
    const { values, step } = ticks(...this.bounds, Math.max(2, Math.floor((box.right - box.left) / 80)));
    pen.textBaseline = "top";
    pen.textAlign = "center";
    for (const value of values) {
      const x = Math.round(place.x(value)) + 0.5;
      pen.strokeStyle = ink.line;
      stroke(pen, x, box.bottom, x, box.bottom + 4);
      pen.fillText(tickText(value, step), x, box.bottom + 6);
    }
    pen.textAlign = "left";
    pen.fillText(this.options.yLabel ?? "", 2, 1);
    pen.textAlign = "right";
    if (axes[1]) pen.fillText(this.options.rightLabel ?? "", width - 2, 1);
    pen.textBaseline = "bottom";
    pen.fillText(this.options.xLabel ?? "", box.right, height);
    pen.textBaseline = "middle";
  }

  paintMarkers(pen, box, place, ink) {
    pen.setLineDash([3, 3]);
    for (const { x, label } of this.options.markers) {
      if (x < this.bounds[0] || x > this.bounds[1]) continue;
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

  paintPointer(pen, box, axes, place, ink) {
    const { series, formatY, formatX } = this.options;
    const shown = this.pointer !== null && this.pointer >= this.bounds[0] && this.pointer <= this.bounds[1];
    let at = null;
    series.forEach((one, index) => {
      const found = shown ? valueAt(one, this.pointer) : null;
      const known = found && found.y !== null && Number.isFinite(found.y);
      setText(this.values[index], known ? `${formatY(found.y)}${one.unit ? ` ${one.unit}` : ""}` : "");
      if (!known) return;
      at ??= found;
      if (one.kind === "bars") return;
      const [low, high] = axes[one.right ? 1 : 0].range;
      const y = box.bottom - ((found.y - low) / (high - low)) * (box.bottom - box.top);
      dot(pen, place.x(found.x), y, 3.5, this.colour(one, index), ink.panel);
    });
    setText(this.at, at ? `at ${at.text ?? formatX(at.x)}` : "");
    if (!at) return;
    pen.strokeStyle = ink.text;
    pen.globalAlpha = 0.5;
    const x = Math.round(place.x(at.x)) + 0.5;
    stroke(pen, x, box.top, x, box.bottom);
    pen.globalAlpha = 1;
  }

  spoken(hasData) {
    const { label, series, formatY, empty } = this.options;
    if (!hasData) return `${label ?? "Chart"}: ${empty}`;
    const parts = series.map((one) => {
      const range = extend([Infinity, -Infinity], one.y);
      return range[0] <= range[1] ? `${one.name ?? ""} from ${formatY(range[0])} to ${formatY(range[1])}` : "";
    });
    return `${label ?? "Chart"}: ${parts.filter(Boolean).join("; ")}`;
  }
}

function valueAt(one, x) {
  if (!one.y.length) return null;
  if (one.kind !== "bars") {
    const index = nearest(one.x, x);
    return { x: one.x[index], y: one.y[index] };
  }
  const index = Math.min(Math.max(firstNotBelow(one.x, x) - 1, 0), one.y.length - 1);
  return { x, y: one.y[index], text: `${significant(one.x[index], 3)} to ${significant(one.x[index + 1], 3)}` };
}
