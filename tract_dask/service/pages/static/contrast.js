// Which counts are black and which are white: two handles under a histogram.

import { h, penOf, setText } from "./dom.js";
import { significant } from "./format.js";
import { theme } from "./theme_colours.js";

/**
 * @import { Levels } from "./api.js"
 * @typedef {[number, number]} Span
 */

const STEPS = 1000;

/**
 * @param {HTMLElement} element where it goes
 * @param {{ onChange: (low: number, high: number) => void }} options called while a handle moves, and for "Auto"
 *
 * `levels` are those of the API (files/histogram, jobs/ID/sum): range, percentiles, counts, edges. Until the user
 * takes a handle, black and white are the percentiles 0.5 and 99.5 of the first levels that were set.
 */
export class Contrast {
  constructor(element, { onChange }) {
    this.onChange = onChange;
    /** @type {Levels | null} */
    this.levels = null;
    /** @type {Span | null} */
    this.chosen = null; // black and white
    /** @type {Span | null} */
    this.span = null; // of the handles
    this.canvas = h("canvas", { "aria-hidden": "true" });
    const slider = (kind, label) => h("input", { type: "range", class: kind, min: 0, max: STEPS, value: kind === "lower" ? 0 : STEPS, "aria-label": label, oninput: () => this.moved(kind) });
    this.sliders = [slider("lower", "Black: counts"), slider("upper", "White: counts")];
    this.ends = h("span", { class: "ends" });
    element.classList.add("contrast");
    element.replaceChildren(h("div", { class: "sliders" }, this.canvas, ...this.sliders),
      h("div", {}, this.ends, h("div", { class: "toolbar" }, h("button", { type: "button", class: "button small quiet end", title: "As suits this picture", onclick: () => this.auto() }, "Auto"))));
    theme.onChange(() => this.draw());
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  /** Low and high in counts; null before there are levels. */
  get value() { return this.chosen; }

  /**
   * Take the values of another picture; black and white stay, unless there are none yet.
   * @param {Levels} levels
   */
  setLevels(levels) {
    this.levels = levels;
    const { range } = levels;
    if (!range) return;
    const chosen = this.chosen ??= suitable(levels, range);
    this.span = [Math.min(range[0], chosen[0]), Math.max(range[1], chosen[1])];
    if (this.span[0] === this.span[1]) this.span[1] += 1;
    this.show(chosen, this.span);
  }

  /** Fit black and white to the picture that is shown. */
  auto() {
    const { levels } = this;
    if (!levels?.range) return;
    const chosen = this.chosen = suitable(levels, levels.range);
    this.setLevels(levels);
    this.onChange(...chosen);
  }

  /** @param {string} kind "lower" or "upper" */
  moved(kind) {
    if (!this.span) return;
    const [low, high] = this.span, least = (high - low) / STEPS;
    const values = /** @type {Span} */ (this.sliders.map((slider) => low + (Number(slider.value) / STEPS) * (high - low)));
    if (values[1] - values[0] < least) {
      if (kind === "lower") values[0] = Math.max(low, values[1] - least); else values[1] = values[0] + least;
    }
    this.chosen = values;
    this.show(values, this.span);
    this.onChange(...values);
  }

  /**
   * @param {Span} chosen
   * @param {Span} span
   */
  show(chosen, [low, high]) {
    this.sliders.forEach((slider, index) => {
      slider.value = String(Math.round(((chosen[index] - low) / (high - low)) * STEPS));
      slider.setAttribute("aria-valuetext", `${significant(chosen[index], 3)} counts`);
    });
    setText(this.ends, `${significant(chosen[0], 3)} to ${significant(chosen[1], 3)} counts`);
    this.draw();
  }

  draw() {
    const { canvas, levels, span, chosen } = this;
    if (!span || !levels || !chosen || !canvas.clientWidth) return;
    const ratio = devicePixelRatio || 1, [width, height] = [canvas.clientWidth, canvas.clientHeight];
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    const pen = penOf(canvas);
    pen.scale(ratio, ratio);
    const x = (/** @type {number} */ value) => ((value - span[0]) / (span[1] - span[0])) * width;
    pen.fillStyle = theme.color("--edge");
    const most = Math.sqrt(Math.max(...levels.counts, 1)); // by the root, or the tail would not be seen
    levels.counts.forEach((number, index) => {
      const [left, right] = [x(levels.edges[index]), x(levels.edges[index + 1])], tall = (Math.sqrt(number) / most) * (height - 3);
      pen.fillRect(left, height - tall, Math.max(right - left, 0.8), tall);
    });
    pen.fillStyle = theme.color("--panel");
    pen.globalAlpha = 0.6;
    pen.fillRect(0, 0, x(chosen[0]), height);
    pen.fillRect(x(chosen[1]), 0, width - x(chosen[1]), height);
    pen.globalAlpha = 1;
    pen.fillStyle = theme.color("--accent");
    for (const value of chosen) pen.fillRect(Math.min(Math.max(x(value) - 0.75, 0), width - 1.5), 0, 1.5, height);
  }
}

/**
 * Black and white as suit a picture.
 * @param {Levels} levels
 * @param {Span} range of its values
 * @returns {Span}
 */
function suitable({ percentiles }, range) {
  const [low, high] = [percentiles?.["0.5"] ?? NaN, percentiles?.["99.5"] ?? NaN];
  return high > low ? [low, high] : range[1] > range[0] ? [...range] : [range[0], range[0] + 1];
}
