// What the colours of columns mean: a bar with its ends in numbers, and the columns themselves.

import { h, penOf, setText } from "./dom.js";
import { significant } from "./format.js";
import { viridis } from "./number_colours.js";
import { theme } from "./theme_colours.js";

/** @import { Scale } from "./number_colours.js" */

/** A bar with its two ends in numbers. */
export class ColourBar {
  /** @param {HTMLElement} element */
  constructor(element) {
    this.canvas = h("canvas", { width: 256, height: 1, class: "colour-bar", "aria-hidden": "true" });
    this.low = h("span", { class: "tabular" });
    this.high = h("span", { class: "tabular" });
    element.classList.add("colour-scale");
    element.replaceChildren(this.low, this.canvas, this.high);
    const pen = penOf(this.canvas);
    for (let x = 0; x < 256; x += 1) { pen.fillStyle = viridis(x / 255); pen.fillRect(x, 0, 1, 1); }
  }

  /**
   * Show a scale of number_colours.js; `format` turns a value into text. Null hides the bar.
   * @param {Scale | null} scale
   * @param {(value: number) => string} format
   */
  show(scale, format = (value) => significant(value, 3)) {
    this.canvas.style.visibility = scale ? "" : "hidden";
    setText(this.low, scale ? format(scale.low) : "");
    setText(this.high, scale ? `${format(scale.high)}${scale.more ? " and more" : ""}` : "");
  }
}

/**
 * Draw a column: a disc of its value's colour, or a ring where it has none.
 * @param {CanvasRenderingContext2D} pen in CSS px
 * @param {{ x: number, y: number }} place
 * @param {number} radius
 * @param {string} colour
 */
export function drawColumn(pen, { x, y }, radius, colour) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  if (colour) {
    pen.fillStyle = colour;
    pen.fill();
  }
  pen.lineWidth = colour ? 1.2 : 1.6;
  pen.strokeStyle = colour ? "rgb(255 255 255 / .85)" : theme.color("--series-2");
  pen.stroke();
}
