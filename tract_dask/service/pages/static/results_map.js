// The columns of a job on its summed image; or with arrows that tell how far they moved.

import { get, url } from "./api.js";
import { ColumnMap } from "./column_map.js";
import { significant } from "./format.js";

/**
 * @import { MapOptions, Row, Shown } from "./column_map.js"
 * @import { Box, ImageView } from "./image_view.js"
 * @typedef {object} Arrows
 * @property {Row[]} rows
 * @property {number} factor
 * @property {string} unit
 * @property {number} pixelSize
 * @property {(row: Row) => boolean} counts
 */

const CONTRAST = ["0.5", "99.5"];

/**
 * The map of a job's columns.
 *
 *   const map = new ResultsMap(element, tip, { job, ... });   // further options as of ColumnMap
 *   await map.load();                                          // size, contrast and version of the summed image
 *   map.show({ arrows })                                       // { rows, factor, unit, pixelSize, counts(row) } or null; others as of ColumnMap
 */
export class ResultsMap extends ColumnMap {
  /**
   * @param {HTMLElement} element
   * @param {HTMLElement} tip
   * @param {MapOptions & { job: string }} options
   */
  constructor(element, tip, { job, ...options }) {
    super(element, tip, options);
    this.job = job;
    this.version = ""; // of the summed image that is shown
  }

  async load() {
    const about = await get(`/jobs/${this.job}/sum`, { width: 1024 });
    if (about.version === this.version) return;
    this.version = about.version;
    const [height, width] = about.shape;
    const [low, high] = CONTRAST.map((name) => about.percentiles?.[name]);
    const range = low < high ? { low, high } : {};
    const address = (/** @type {Box} */ box, /** @type {number} */ w) => url(`/jobs/${this.job}/sum.png`, { box: [box.x0, box.y0, box.x1, box.y1].join(","), width: w, v: about.version, ...range });
    this.setImage({ width, height, pixelSizePm: about.pixel_size_pm, url: address });
  }

  /** @param {Partial<Shown> & { arrows?: Arrows | null }} changes */
  show({ arrows, ...changes }) {
    if (arrows !== undefined) changes.layer = arrows && ((pen) => { if (this.view) drawArrows(pen, this.view, arrows); });
    super.show(changes);
  }
}

/**
 * Draw { rows, factor, unit, pixelSize, counts(row) }: displacements, and a key that tells how long they are.
 * @param {CanvasRenderingContext2D} pen
 * @param {ImageView} view
 * @param {Arrows} arrows
 */
function drawArrows(pen, view, { rows, factor, unit, pixelSize, counts }) {
  const perUnit = (view.scale * factor) / pixelSize; // CSS px for a pm
  pen.lineCap = "round";
  for (const row of rows) {
    if (row.dx === null || row.dy === null) continue;
    const { x, y } = view.toScreen(row.x, row.y);
    arrow(pen, x, y, row.dx * perUnit, row.dy * perUnit, counts(row) ? "#ffd33d" : "rgb(255 255 255 / 55%)");
  }
  const length = round(70 / perUnit), text = `${significant(length)} ${unit}`;
  const box = { width: Math.max(length * perUnit, 60) + 24, height: 42 }, [left, top] = [view.size.width - box.width - 10, 10];
  pen.fillStyle = "rgb(0 0 0 / 60%)";
  pen.beginPath();
  pen.roundRect(left, top, box.width, box.height, 5);
  pen.fill();
  arrow(pen, left + 12, top + 30, length * perUnit, 0, "#ffd33d");
  pen.fillStyle = "#fff";
  pen.font = "600 12px system-ui, sans-serif";
  pen.textBaseline = "middle";
  pen.fillText(text, left + 12, top + 14);
}

/**
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x
 * @param {number} y
 * @param {number} dx
 * @param {number} dy
 * @param {string} colour
 */
function arrow(pen, x, y, dx, dy, colour) {
  const length = Math.hypot(dx, dy), head = Math.min(8, 0.45 * length), turn = Math.atan2(dy, dx);
  for (const [width, style] of /** @type {[number, string][]} */ ([[4.5, "rgb(0 0 0 / 70%)"], [2.2, colour]])) {
    pen.lineWidth = width;
    pen.strokeStyle = style;
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + dx, y + dy);
    for (const side of [-0.5, 0.5]) {
      pen.moveTo(x + dx, y + dy);
      pen.lineTo(x + dx - head * Math.cos(turn + side), y + dy - head * Math.sin(turn + side));
    }
    pen.stroke();
  }
}

/**
 * 1, 2 or 5 times a power of ten, not above `value`.
 * @param {number} value
 */
export function round(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return ([5, 2].find((digit) => digit * power <= value * 1.0001) ?? 1) * power;
}
