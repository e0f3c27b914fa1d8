// The columns of a job on its summed image; or with arrows that tell how far they moved.

import { get, url } from "/static/api.js";
import { ColumnMap } from "/static/column_map.js";
import { significant } from "/static/format.js";

const CONTRAST = ["0.5", "99.5"];

/**
 * The map of a job's columns.
 *
 *   const map = new ResultsMap(element, tip, { job, ... });   // further options as of ColumnMap
 *   await map.load();                                          // size, contrast and version of the summed image
 *   map.show({ arrows })                                       // { rows, factor, unit, pixelSize, counts(row) } or null; others as of ColumnMap
 */
export class ResultsMap extends ColumnMap {
  async load() {
    const about = await get(`/jobs/${this.options.job}/sum`, { width: 1024 });
    if (about.version === this.about?.version) return;
    this.about = about;
    const [height, width] = about.shape;
    const [low, high] = CONTRAST.map((name) => about.percentiles?.[name]);
    const range = low < high ? { low, high } : {};
    const address = (box, w) => url(`/jobs/${this.options.job}/sum.png`, { box: [box.x0, box.y0, box.x1, box.y1].join(","), width: w, v: about.version, ...range });
    this.setImage({ width, height, pixelSizePm: about.pixel_size_pm, url: address });
  }

  show({ arrows, ...changes }) {
    if (arrows !== undefined) changes.layer = arrows && ((pen) => drawArrows(pen, this.view, arrows));
    super.show(changes);
  }
}

/** Draw { rows, factor, unit, pixelSize, counts(row) }: displacements, and a key that tells how long they are. */
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

function arrow(pen, x, y, dx, dy, colour) {
  const length = Math.hypot(dx, dy), head = Math.min(8, 0.45 * length), turn = Math.atan2(dy, dx);
  for (const [width, style] of [[4.5, "rgb(0 0 0 / 70%)"], [2.2, colour]]) {
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

/** 1, 2 or 5 times a power of ten, not above `value`. */
export function round(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((digit) => digit * power).find((one) => one <= value * 1.0001);
}
