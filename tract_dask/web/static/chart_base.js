// What all charts have in common: a canvas that stays sharp and follows the theme, a legend, axes.

import { h, penOf } from "./dom.js";
import { tickText, ticks } from "./chart_scale.js";
import { theme } from "./theme_colours.js";
import { stroke } from "./chart_paint.js";

/**
 * @import { Range } from "./chart_scale.js"
 * @typedef {{ left: number, right: number, top: number, bottom: number }} Inside of the axes, px
 * @typedef {{ text: string, line: string, panel: string, accent: string }} Ink
 * @typedef {{ x: (value: number) => number, y: (value: number) => number, toX: (px: number) => number, toY: (px: number) => number }} Places
 * @typedef {{ range: Range, values: number[], texts: string[], room: number }} Axis
 * @typedef {{ xLabel?: string, yLabel?: string, rightLabel?: string }} Labels
 * @typedef {{ label?: string, height: number, empty: string }} ChartOptions that all kinds have
 */

const FONT = '11.5px system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif';

/**
 * A chart, redrawn whole, at most once a frame of the screen. Its kinds say what is empty here.
 * @template {ChartOptions} Options
 */
export class Chart {
  /**
   * @param {HTMLElement} element
   * @param {Options} options
   */
  constructor(element, options) {
    this.options = options;
    this.frame = 0;
    this.legend = h("div", { class: "chart-legend" });
    this.canvas = h("canvas", { tabindex: 0, role: "img", style: { height: `${options.height}px` } });
    this.whole = h("button", { type: "button", class: "button small chart-whole", hidden: true, onclick: () => this.chooseView(null) }, "Whole range");
    element.classList.add("chart");
    element.replaceChildren(this.legend, this.canvas, this.whole);
    this.element = element;
    this.sizes = new ResizeObserver(() => this.draw());
    this.sizes.observe(this.canvas);
    this.stopTheme = theme.onChange(() => { this.makeLegend(); this.draw(); });
    this.canvas.addEventListener("dblclick", () => this.chooseView(null));
    this.listen();
    this.makeLegend();
    this.draw();
  }

  listen() {}

  makeLegend() {}

  paint() {}

  /** @param {any} _view what the user chose to see, as the kind has it; null: all */
  chooseView(_view) {}

  destroy() {
    this.sizes.disconnect();
    this.stopTheme();
    cancelAnimationFrame(this.frame);
    this.element.replaceChildren();
  }

  /**
   * A color of the options: a number is that of a series, a name a variable of the style sheet.
   * @param {number | string} color
   */
  colour(color) {
    return typeof color === "number" ? theme.color(`--series-${color}`) : color.startsWith("--") ? theme.color(color) : color;
  }

  draw() {
    if (!this.frame) this.frame = requestAnimationFrame(() => { this.frame = 0; this.paint(); });
  }

  /** An empty canvas to draw on in CSS px: { pen, width, height, ink }; null while it is not seen. */
  begin() {
    const width = this.canvas.clientWidth, { height } = this.options;
    if (!width) return null;
    const ratio = devicePixelRatio || 1;
    const [pixelsX, pixelsY] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== pixelsX || this.canvas.height !== pixelsY) Object.assign(this.canvas, { width: pixelsX, height: pixelsY });
    const pen = penOf(this.canvas);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = FONT;
    const ink = { text: theme.color("--muted"), line: theme.color("--line"), panel: theme.color("--panel"), accent: theme.color("--accent") };
    return { pen, width, height, ink };
  }

  /**
   * What the user drags over, from corner to corner.
   * @param {CanvasRenderingContext2D} pen
   * @param {Ink} ink
   */
  paintDrag(pen, ink, x0, y0, x1, y1) {
    pen.globalAlpha = 0.18;
    pen.fillStyle = ink.accent;
    pen.fillRect(Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0));
    pen.globalAlpha = 1;
  }

  /**
   * The text of a chart without data, or of what is in it.
   * @param {string} text
   */
  speak(text) { this.canvas.setAttribute("aria-label", `${this.options.label ?? "Chart"}: ${text}`); }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Inside} box
   * @param {Ink} ink
   */
  paintEmpty(pen, box, ink) {
    pen.fillStyle = ink.text;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(this.options.empty, (box.left + box.right) / 2, (box.top + box.bottom) / 2);
  }
}

/**
 * The inside of the axes, in px; `axes` are those at the left and, if there is one, at the right; `top`: room for labels above.
 * @param {Axis[]} axes
 * @returns {Inside}
 */
export const boxOf = (axes, width, height, top = 24) => ({ left: axes[0].room, right: width - (axes[1] ? axes[1].room : 10), top, bottom: height - 32 });

/**
 * Where values lie in the box: { x(value), y(value) } in px, and { toX(px), toY(px) } back.
 * @param {Inside} box
 * @param {Range} xRange
 * @param {Range} yRange
 * @returns {Places}
 */
export function places(box, [x0, x1], [y0, y1]) {
  const wide = (box.right - box.left) / (x1 - x0), high = (box.bottom - box.top) / (y1 - y0);
  return {
    x: (x) => box.left + (x - x0) * wide, y: (y) => box.bottom - (y - y0) * high,
    toX: (px) => x0 + (px - box.left) / wide, toY: (px) => y0 + (box.bottom - px) / high,
  };
}

/**
 * An upright axis: its range, its ticks, and the room that their texts need.
 * @param {CanvasRenderingContext2D} pen
 * @param {Range} range
 * @param {number} height
 * @returns {Axis}
 */
export function axisOf(pen, range, height) {
  const wanted = Math.max(2, Math.round((height - 52) / 38));
  const few = ticks(...range, wanted);
  const { values, step } = few.values.length > 1 ? few : ticks(...range, 2 * wanted); // one number is no scale
  const texts = values.map((value) => tickText(value, step));
  return { range, values, texts, room: Math.max(28, ...texts.map((text) => pen.measureText(text).width)) + 10 };
}

/**
 * Draw the axes at the left and, if there is one, at the right, and that of x over `bounds`, with the labels of `options`.
 * @param {CanvasRenderingContext2D} pen
 * @param {Inside} box
 * @param {Axis[]} axes
 * @param {Range} bounds
 * @param {Ink} ink
 * @param {Labels} labels
 */
export function paintAxes(pen, box, axes, bounds, ink, { xLabel, yLabel, rightLabel }, width, height) {
  pen.lineWidth = 1;
  pen.textBaseline = "middle";
  axes.forEach((axis, side) => {
    pen.textAlign = side ? "left" : "right";
    const place = places(box, bounds, axis.range);
    axis.values.forEach((value, index) => {
      const y = Math.round(place.y(value)) + 0.5;
      pen.strokeStyle = ink.line;
      if (!side) stroke(pen, box.left, y, box.right, y);
      pen.fillStyle = ink.text;
      pen.fillText(axis.texts[index], side ? box.right + 7 : box.left - 7, y);
    });
  });
  const { values, step } = ticks(...bounds, Math.max(2, Math.floor((box.right - box.left) / 80)));
  const place = places(box, bounds, axes[0].range);
  pen.textBaseline = "top";
  pen.textAlign = "center";
  for (const value of values) {
    const x = Math.round(place.x(value)) + 0.5;
    pen.strokeStyle = ink.line;
    stroke(pen, x, box.bottom, x, box.bottom + 4);
    pen.fillText(tickText(value, step), x, box.bottom + 6);
  }
  pen.textAlign = "left";
  pen.fillText(yLabel ?? "", 2, 1);
  pen.textAlign = "right";
  if (axes[1]) pen.fillText(rightLabel ?? "", width - 2, 1);
  pen.textBaseline = "bottom";
  pen.fillText(xLabel ?? "", box.right, height);
  pen.textBaseline = "middle";
}

/**
 * Let what follows be drawn inside the box only, until pen.restore().
 * @param {CanvasRenderingContext2D} pen
 * @param {Inside} box
 */
export function clip(pen, box) {
  pen.save();
  pen.beginPath();
  pen.rect(box.left, box.top - 2, box.right - box.left, box.bottom - box.top + 4);
  pen.clip();
}
