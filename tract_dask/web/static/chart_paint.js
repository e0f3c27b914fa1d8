// What a chart draws on its canvas: lines, bands, points and bars.

import { firstNotBelow } from "./chart_scale.js";

/**
 * @import { Inside, Places } from "./chart_base.js"
 * @import { Gappy, Range } from "./chart_scale.js"
 * @typedef {object} Series of a chart, as charts.js says
 * @property {string} [name]
 * @property {ArrayLike<number>} x
 * @property {Gappy} y
 * @property {Gappy} [low]
 * @property {Gappy} [high]
 * @property {number | string} [color]
 * @property {string} [kind]
 * @property {boolean} [right]
 * @property {string} [unit]
 * @property {boolean} [dashed]
 * @property {boolean} [gaps]
 * @typedef {[x: number, y: number]} Spot in px
 * @typedef {{ x: number, low: number, high: number }} Slice of a band, px
 */

/**
 * Draw a series of charts.js in `colour`; `place` maps x and y to px, `box` is the inside of the axes.
 * @param {CanvasRenderingContext2D} pen
 * @param {Series} one
 * @param {string} colour
 * @param {Range} bounds
 * @param {Places} place
 * @param {Inside} box
 */
export function paintSeries(pen, one, colour, [x0, x1], place, box) {
  if (!one.y.length) return;
  pen.strokeStyle = pen.fillStyle = colour;
  if (one.kind === "bars") { paintBars(pen, one, place, box); return; }
  const start = Math.max(0, firstNotBelow(one.x, x0) - 1), stop = Math.min(one.y.length, firstNotBelow(one.x, x1) + 1);
  if (one.low) paintBand(pen, one, start, stop, place);
  if (one.kind === "band") return;
  pen.lineWidth = 1.6;
  pen.lineJoin = "round";
  pen.setLineDash(one.dashed ? [5, 4] : []);
  const runs = one.kind === "points" ? [] : thinned(one, start, stop, place);
  for (const run of runs) {
    pen.beginPath();
    for (const [x, y] of run) pen.lineTo(x, y);
    pen.stroke();
    if (run.length === 1 && one.kind !== "dots") dot(pen, ...run[0], 1.6, colour);
    if (one.kind === "area" && run.length > 1) {
      pen.lineTo(run[run.length - 1][0], box.bottom);
      pen.lineTo(run[0][0], box.bottom);
      pen.globalAlpha = 0.14;
      pen.fill();
      pen.globalAlpha = 1;
    }
  }
  pen.setLineDash([]);
  if (one.kind !== "points" && one.kind !== "dots") return;
  const size = Math.max(1, Math.min(2.6, (box.right - box.left) / (stop - start) / 2.5));
  for (let index = start; index < stop; index += 1) {
    const y = one.y[index];
    if (known(y)) dot(pen, place.x(one.x[index]), place.y(y), size, colour);
  }
}

/**
 * @param {CanvasRenderingContext2D} pen
 * @param {Series} one
 * @param {Places} place
 * @param {Inside} box
 */
function paintBars(pen, one, place, box) {
  const floor = Math.min(place.y(0), box.bottom);
  pen.globalAlpha = 0.75;
  [...one.y].forEach((value, index) => {
    const left = place.x(one.x[index]), right = place.x(one.x[index + 1]), top = place.y(value ?? 0);
    if (value) pen.fillRect(left + 0.5, top, Math.max(right - left - 1, 1), floor - top);
  });
  pen.globalAlpha = 1;
}

/**
 * @param {CanvasRenderingContext2D} pen
 * @param {Series} one
 * @param {Places} place
 */
function paintBand(pen, one, start, stop, place) {
  pen.globalAlpha = 0.2;
  for (const run of bands(one, start, stop, place)) {
    if (run.length === 1) { stroke(pen, run[0].x, run[0].low, run[0].x, run[0].high); continue; }
    pen.beginPath();
    for (const { x, high } of run) pen.lineTo(x, high);
    for (const { x, low } of run.reverse()) pen.lineTo(x, low);
    pen.fill();
  }
  pen.globalAlpha = 1;
}

/**
 * The runs of a band between gaps, in px; where several fall on a pixel, as far as they reach together.
 * @param {Series} one
 * @param {Places} place
 */
function bands(one, start, stop, place) {
  /** @type {Slice[][]} */
  const runs = [];
  let run = /** @type {Slice[] | null} */ (null);
  const reach = reachOf(one);
  for (let index = start; index < stop; index += 1) {
    const least = one.low?.[index], most = one.high?.[index];
    if (one.x[index] - one.x[index - 1] > reach) run = null;
    if (!known(least) || !known(most)) { run = null; continue; }
    if (!run) runs.push(run = []);
    const x = place.x(one.x[index]), low = place.y(least), high = place.y(most), last = run[run.length - 1];
    if (last && Math.floor(last.x) === Math.floor(x)) Object.assign(last, { low: Math.max(last.low, low), high: Math.min(last.high, high) });
    else run.push({ x, low, high });
  }
  return runs;
}

/**
 * The runs between gaps as points in px; where several fall on a pixel, its first, lowest, highest and last.
 * @param {Series} one
 * @param {Places} place
 */
function thinned(one, start, stop, place) {
  const { x: xs, y: ys } = one, reach = reachOf(one);
  /** @type {Spot[][]} */
  const runs = [];
  let run = /** @type {Spot[] | null} */ (null);
  let column = /** @type {{ pixel: number, first: Spot, low: Spot, high: Spot, last: Spot } | null} */ (null);
  const flush = () => {
    if (!column || !run) return;
    const { first, low, high, last } = column;
    run.push(first);
    if (low !== first && low !== last) run.push(low);
    if (high !== first && high !== last && high !== low) run.push(high);
    if (last !== first) run.push(last);
    column = null;
  };
  for (let index = start; index < stop; index += 1) {
    const y = ys[index];
    if (xs[index] - xs[index - 1] > reach) { flush(); run = null; }
    if (!known(y)) { flush(); run = null; continue; }
    if (!run) runs.push(run = []);
    const point = /** @type {Spot} */ ([place.x(xs[index]), place.y(y)]), pixel = Math.floor(point[0]);
    if (column?.pixel !== pixel) { flush(); column = { pixel, first: point, low: point, high: point, last: point }; continue; }
    column.last = point;
    if (point[1] < column.low[1]) column.low = point;
    if (point[1] > column.high[1]) column.high = point;
  }
  flush();
  return runs;
}

const LOST = 1.5; // a step so many times the usual one is a gap, in which frames were lost
/** @type {WeakMap<object, number>} */
const reaches = new WeakMap();

/**
 * How far apart points may be that a line joins: any distance, or in a series with `gaps` little more than the usual step.
 * @param {Series} one
 */
function reachOf({ x, gaps }) {
  if (!gaps || x.length < 3) return Infinity;
  const kept = reaches.get(x);
  if (kept !== undefined) return kept;
  const steps = Array.from({ length: x.length - 1 }, (_, index) => x[index + 1] - x[index]).sort((a, b) => a - b);
  const reach = LOST * steps[Math.floor(steps.length / 2)];
  reaches.set(x, reach);
  return reach;
}

/**
 * @param {number | null | undefined} value
 * @returns {value is number}
 */
function known(value) { return typeof value === "number" && Number.isFinite(value); }

/**
 * Draw a straight line.
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x0
 * @param {number} y0
 * @param {number} x1
 * @param {number} y1
 */
export function stroke(pen, x0, y0, x1, y1) {
  pen.lineWidth = 1;
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.stroke();
}

/**
 * Draw a disc, with an edge where it shall stand out.
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 * @param {string} colour
 */
export function dot(pen, x, y, radius, colour, edge = "") {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
  pen.fillStyle = colour;
  pen.fill();
  if (!edge) return;
  pen.strokeStyle = edge;
  pen.lineWidth = 1.5;
  pen.stroke();
}
