// The columns on an image: as discs in the colours of a number; one under the pointer is told, one that is clicked chosen.

import { h } from "./dom.js";
import { ImageView } from "./image_view.js";
import { theme } from "./theme_colours.js";

const CLICK_PX = 4;
const REACH_PX = 14; // a click so near to a column means it
const UNKNOWN = "#8d96a0";

/**
 * The map.
 *
 *   const map = new ColumnMap(element, tip, { onToggle: (row, event) => {}, describe: (row) => [title, ...lines] });
 *   map.setImage({ width, height, pixelSizePm, url })   // as of ImageView; `picture` in place of `url`
 *   map.show({ rows, colourOf, chosen, picked, layer })  // any of them
 *
 * `rows`: columns with column_id, x, y; `colourOf(row)`: a CSS colour, or null; `chosen`: Map of id to colour;
 * `picked`: Set of ids, others are faint, or null; `layer(pen)`: draws over the discs, which are small then, or null.
 */
export class ColumnMap {
  constructor(element, tip, options) {
    Object.assign(this, { element, tip, options, rows: [], colourOf: () => null, chosen: new Map(), picked: null, layer: null });
    this.over = null;
    this.listen();
  }

  setImage({ url, picture, ...image }) {
    if (this.view) {
      Object.assign(this.view.options, { url, picture });
      this.view.setImage(image);
      return;
    }
    this.view = new ImageView(this.element, { ...image, url, picture, onDraw: (pen) => this.draw(pen), onHover: (point) => this.hover(point) });
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
      if (row) this.options.onToggle(row, event);
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
      pen.arc(x, y, this.layer ? Math.min(radius, 3) : radius, 0, 2 * Math.PI);
      if (colour) {
        pen.fillStyle = colour;
        pen.fill();
      }
      for (const [width, style] of colour ? [[1.2, "rgb(255 255 255 / 85%)"]] : [[3.5, "rgb(0 0 0 / 50%)"], [1.4, UNKNOWN]]) {
        pen.lineWidth = width;
        pen.strokeStyle = style;
        pen.stroke();
      }
    }
    pen.globalAlpha = 1;
    this.layer?.(pen);
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
}

/** The median distance to the nearest neighbour, px, of some of the columns. */
function spacing(rows) {
  const some = rows.slice(0, 200);
  const nearest = some.map((one) => Math.min(...rows.filter((other) => other !== one).map((other) => Math.hypot(other.x - one.x, other.y - one.y))));
  const known = nearest.filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[known.length >> 1] : 20;
}
