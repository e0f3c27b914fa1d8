// The columns on the summed image: as discs in the colours of a number, or with arrows that tell how far they moved.

import { get, theme, url } from "/static/api.js";
import { h } from "/static/dom.js";
import { significant } from "/static/format.js";
import { ImageView } from "/static/image_view.js";

const CLICK_PX = 4;
const REACH_PX = 14; // a click so near to a column means it
const UNKNOWN = "#8d96a0";
const CONTRAST = ["0.5", "99.5"];

/**
 * The map.
 *
 *   const map = new ColumnMap(element, tip, { job, onToggle: (id, event) => {}, describe: (row) => [title, ...lines] });
 *   await map.load();                                    // size, contrast and version of the summed image
 *   map.show({ rows, colourOf, chosen, picked, arrows })  // any of them
 *
 * `rows`: columns with column_id, x, y; `colourOf(row)`: a CSS colour, or null; `chosen`: Map of id to colour;
 * `picked`: Set of ids, others are faint, or null; `arrows`: { rows, factor, unit, pixelSize, counts(row) } or null.
 */
export class ColumnMap {
  constructor(element, tip, options) {
    Object.assign(this, { element, tip, options, rows: [], colourOf: () => null, chosen: new Map(), picked: null, arrows: null });
    this.over = null;
    this.listen();
  }

  async load() {
    const about = await get(`/jobs/${this.options.job}/sum`, { width: 1024 });
    if (about.version === this.about?.version) return;
    this.about = about;
    const [height, width] = about.shape;
    const [low, high] = CONTRAST.map((name) => about.percentiles?.[name]);
    const range = low < high ? { low, high } : {};
    const address = (box, w) => url(`/jobs/${this.options.job}/sum.png`, { box: [box.x0, box.y0, box.x1, box.y1].join(","), width: w, v: about.version, ...range });
    if (this.view) {
      this.view.options.url = address;
      this.view.setImage({ width, height, pixelSizePm: about.pixel_size_pm });
      return;
    }
    this.view = new ImageView(this.element, {
      width, height, pixelSizePm: about.pixel_size_pm, url: address,
      onDraw: (pen) => this.draw(pen),
      onHover: (point) => this.hover(point),
    });
  }

  show(changes) {
    Object.assign(this, changes);
    if (changes.rows) this.radius = spacing(this.rows) * 0.22;
    this.view?.redraw();
  }

  listen() {
    let from = null;
    this.element.addEventListener("pointerdown", (event) => { from = event.button === 0 ? [event.clientX, event.clientY] : null; });
    this.element.addEventListener("pointerup", (event) => {
      const still = from && Math.hypot(event.clientX - from[0], event.clientY - from[1]) < CLICK_PX;
      from = null;
      if (!still) return;
      const frame = this.element.getBoundingClientRect();
      const row = this.nearest(event.clientX - frame.left, event.clientY - frame.top);
      if (row) this.options.onToggle(row.column_id, event);
    });
    theme.onChange(() => this.view?.redraw());
  }

  /** The column under a place in CSS px; null where none is near. */
  nearest(sx, sy) {
    let best = null, least = Math.max(REACH_PX, this.discPx()) ** 2;
    for (const row of this.rows) {
      const at = this.view.toScreen(row.x, row.y), away = (at.x - sx) ** 2 + (at.y - sy) ** 2;
      if (away < least) [best, least] = [row, away];
    }
    return best;
  }

  discPx() { return Math.min(13, Math.max(3.5, this.radius * this.view.scale)); }

  hover(point) {
    const row = point && this.nearest(point.sx, point.sy);
    if (row !== this.over) {
      this.over = row;
      this.element.toggleAttribute("data-over", Boolean(row));
      this.view.redraw();
    }
    this.tip.hidden = !row;
    if (!row) return;
    const [title, ...lines] = this.options.describe(row);
    this.tip.replaceChildren(h("b", {}, title), ...lines.map((line) => h("div", {}, line)));
    const at = this.view.toScreen(row.x, row.y), size = this.view.size;
    this.tip.style.left = at.x > size.width / 2 ? "auto" : `${at.x + 16}px`;
    this.tip.style.right = at.x > size.width / 2 ? `calc(100% - ${at.x - 16}px)` : "auto";
    this.tip.style.top = `${Math.min(Math.max(at.y - 20, 4), Math.max(4, size.height - this.tip.offsetHeight - 4))}px`;
  }

  draw(pen) {
    const radius = this.discPx();
    for (const row of this.rows) {
      const { x, y } = this.view.toScreen(row.x, row.y), colour = this.colourOf(row), faint = this.picked && !this.picked.has(row.column_id);
      pen.globalAlpha = faint ? 0.22 : 1;
      pen.beginPath();
      pen.arc(x, y, this.arrows ? Math.min(radius, 3) : radius, 0, 2 * Math.PI);
      if (colour) {
        pen.fillStyle = colour;
        pen.fill();
      }
      pen.lineWidth = 1.2;
      pen.strokeStyle = colour ? "rgb(255 255 255 / 85%)" : UNKNOWN;
      pen.stroke();
    }
    pen.globalAlpha = 1;
    if (this.arrows) this.drawArrows(pen);
    for (const row of this.rows) {
      const own = this.chosen.get(row.column_id);
      if (own) this.ring(pen, row, radius + 4, own, String(row.column_id));
      else if (row === this.over) this.ring(pen, row, radius + 3, "#fff", "");
    }
  }

  ring(pen, row, radius, colour, text) {
    const { x, y } = this.view.toScreen(row.x, row.y);
    for (const [width, style] of [[5, "rgb(0 0 0 / 65%)"], [2.8, colour]]) {
      pen.lineWidth = width;
      pen.strokeStyle = style;
      pen.beginPath();
      pen.arc(x, y, radius, 0, 2 * Math.PI);
      pen.stroke();
    }
    if (!text) return;
    pen.font = "650 12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.lineWidth = 3.5;
    pen.strokeStyle = "rgb(0 0 0 / 75%)";
    pen.strokeText(text, x + radius + 4, y - radius);
    pen.fillStyle = "#fff";
    pen.fillText(text, x + radius + 4, y - radius);
  }

  drawArrows(pen) {
    const { rows, factor, unit, pixelSize, counts } = this.arrows;
    const perUnit = (this.view.scale * factor) / pixelSize; // CSS px for a pm
    pen.lineCap = "round";
    for (const row of rows) {
      if (row.dx === null || row.dy === null) continue;
      const { x, y } = this.view.toScreen(row.x, row.y);
      arrow(pen, x, y, row.dx * perUnit, row.dy * perUnit, counts(row) ? "#ffd33d" : "rgb(255 255 255 / 55%)");
    }
    const length = round(70 / perUnit), text = `${significant(length)} ${unit}`;
    const box = { width: Math.max(length * perUnit, 60) + 24, height: 42 }, [left, top] = [this.view.size.width - box.width - 10, 10];
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

/** The median distance to the nearest neighbour, px, of some of the columns. */
function spacing(rows) {
  const some = rows.slice(0, 200);
  const nearest = some.map((one) => Math.min(...rows.filter((other) => other !== one).map((other) => Math.hypot(other.x - one.x, other.y - one.y))));
  const known = nearest.filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[known.length >> 1] : 20;
}

/** 1, 2 or 5 times a power of ten, not above `value`. */
export function round(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((digit) => digit * power).find((one) => one <= value * 1.0001);
}
