// Colours for numbers: viridis, which is even to the eye, also to those who do not see red and green apart.

import { tickText, ticks } from "./chart_scale.js";
import { penOf } from "./dom.js";
import { theme } from "./theme_colours.js";

/**
 * @typedef {object} Scale
 * @property {number} low
 * @property {number} high
 * @property {boolean} more whether some values lie above
 * @property {(value: number) => string} colour
 */

const VIRIDIS = [
  [68, 1, 84], [72, 26, 108], [71, 47, 125], [65, 68, 135], [57, 86, 140], [49, 104, 142], [42, 120, 142], [35, 136, 142],
  [31, 152, 139], [34, 168, 132], [53, 183, 121], [84, 197, 104], [122, 209, 81], [165, 219, 54], [210, 226, 27], [253, 231, 37],
];
const HIGHEST = 0.95; // share of the columns that the scale covers: one that is far off shall not make all others alike

/**
 * The colour of a share 0 to 1 of the scale.
 * @param {number} share
 */
export function viridis(share) {
  const place = Math.min(1, Math.max(0, share)) * (VIRIDIS.length - 1);
  const low = Math.min(VIRIDIS.length - 2, Math.floor(place)), part = place - low;
  const [r, g, b] = VIRIDIS[low].map((value, index) => Math.round(value + part * (VIRIDIS[low + 1][index] - value)));
  return `rgb(${r} ${g} ${b})`;
}

/**
 * A scale for these values; null without values.
 * @param {(number | null | undefined)[]} values
 * @returns {Scale | null}
 */
export function scaleOf(values) {
  const known = values.filter((value) => typeof value === "number").filter(Number.isFinite).sort((a, b) => a - b);
  if (!known.length) return null;
  const low = known[0], last = known[known.length - 1];
  const high = known[Math.min(known.length - 1, Math.ceil(HIGHEST * (known.length - 1)))];
  const width = high - low;
  return { low, high, more: last > high, colour: (value) => viridis(width > 0 ? (value - low) / width : 0.5) };
}

/**
 * Draw the scale as an upright bar with its label and ticks.
 * @param {HTMLCanvasElement} canvas
 * @param {Scale | null} scale
 * @param {string} label
 */
export function drawColourBar(canvas, scale, label) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.setAttribute("aria-label", scale ? `Colours: ${label} from ${scale.low} to ${scale.high}` : "");
  const pen = penOf(canvas);
  pen.scale(ratio, ratio);
  if (!scale || height < 80) return;
  const [top, bottom, wide] = [scale.more ? 54 : 34, height - 10, 14];
  for (let y = top; y < bottom; y += 1) {
    pen.fillStyle = viridis((bottom - y) / (bottom - top));
    pen.fillRect(0, y, wide, 1.5);
  }
  pen.fillStyle = theme.color("--muted");
  pen.font = '11.5px system-ui, "Segoe UI", Roboto, sans-serif';
  pen.textBaseline = "middle";
  const [name, unit] = label.split(" (");
  pen.fillText(name, 0, 8, width);
  pen.fillText(unit ? `(${unit}` : "", 0, 22, width);
  const { values, step } = scale.high > scale.low ? ticks(scale.low, scale.high, Math.max(2, (bottom - top) / 45)) : { values: [scale.low], step: Math.abs(scale.low) || 1 };
  for (const value of values) {
    const share = scale.high > scale.low ? (value - scale.low) / (scale.high - scale.low) : 0.5;
    const y = bottom - share * (bottom - top);
    pen.fillRect(wide, y - 0.5, 4, 1);
    pen.fillText(tickText(value, step), wide + 7, y);
  }
  if (scale.more) pen.fillText("▲ more", 0, top - 15, width);
}
