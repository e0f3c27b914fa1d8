// The scale bar of an image.

/** @import { ImageView } from "./image_view.js" */

/**
 * A bar of a round length of about a sixth of the width: nm, pm where that is less than a tenth of one, else px.
 * @param {CanvasRenderingContext2D} context
 * @param {ImageView} view
 */
export function drawScaleBar(context, view) {
  const { pixelSizePm, size } = view;
  const perUnit = pixelSizePm ? (1000 * view.scale) / pixelSizePm : view.scale; // CSS px a nm, or a px
  const target = Math.min(160, Math.max(50, size.width / 6)) / perUnit;
  const power = 10 ** Math.floor(Math.log10(target));
  const length = ([5, 2, 1].find((digit) => digit * power <= target * 1.0001) ?? 1) * power;
  const text = !pixelSizePm ? `${number(length)} px` : length < 0.1 ? `${number(1000 * length)} pm` : `${number(length)} nm`;
  const wide = length * perUnit;
  context.save();
  context.font = "600 12px system-ui, sans-serif";
  const box = { width: Math.max(wide, context.measureText(text).width) + 20, height: 34 };
  const [left, top] = [10, size.height - box.height - 10];
  context.fillStyle = "rgb(0 0 0 / 55%)";
  context.beginPath();
  context.roundRect(left, top, box.width, box.height, 5);
  context.fill();
  context.fillStyle = "#fff";
  context.textAlign = "center";
  context.fillText(text, left + box.width / 2, top + 15);
  context.fillRect(left + (box.width - wide) / 2, top + 22, wide, 4);
  context.restore();
}

function number(value) {
  return Number(value.toPrecision(2)).toString();
}
