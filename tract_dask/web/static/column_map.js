// The columns on an image: as discs in the colours of a number; one under the pointer is told, one that is clicked chosen.

import { h } from "./dom.js";
import { ImageView } from "./image_view.js";
import { theme } from "./theme_colours.js";

/**
 * @import { Behaviour, Image, Point, Pointed } from "./image_view.js"
 * @typedef {{ column_id: number, x: number, y: number, [name: string]: any }} Row of a column
 * @typedef {object} Shown
 * @property {Row[]} rows
 * @property {(row: Row) => string | null} colourOf
 * @property {Map<number, string>} chosen
 * @property {Set<number> | null} picked
 * @property {((pen: CanvasRenderingContext2D) => void) | null} layer
 * @typedef {{ onToggle: (row: Row, event: PointerEvent) => void, describe: (row: Row) => string[] }} MapOptions
 */

const CLICK_PX = 4;
const REACH_PX = 14; // a click so near to a column means it
/** @type {[number, string][]} */
const KNOWN_EDGE = [[1.2, "rgb(255 255 255 / 85%)"]];
/** @type {[number, string][]} */
const UNKNOWN_EDGE = [[3.5, "rgb(0 0 0 / 50%)"], [1.4, "#8d96a0"]];

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
  /**
   * @param {HTMLElement} element
   * @param {HTMLElement} tip
   * @param {MapOptions} options
   */
  constructor(element, tip, options) {
    this.element = element;
    this.tip = tip;
    this.options = options;
    /** @type {Shown} */
    this.shown = { rows: [], colourOf: () => null, chosen: new Map(), picked: null, layer: null };
    this.radius = 0; // of a disc, px of the image
    /** @type {ImageView | null} */
    this.view = null;
    /** @type {Row | null} */
    this.over = null;
    this.listen();
  }

  /** @param {Image & Behaviour} image */
  setImage({ url, picture, ...image }) {
    if (this.view) {
      Object.assign(this.view.options, { url, picture });
      this.view.setImage(image);
      return;
    }
    this.view = new ImageView(this.element, { ...image, url, picture, onDraw: (pen, view) => this.draw(pen, view), onHover: (point) => { if (this.view) this.hover(this.view, point); } });
  }

  /** @param {Partial<Shown>} changes */
  show(changes) {
    Object.assign(this.shown, changes);
    if (changes.rows) this.radius = spacing(changes.rows) * 0.22;
    this.view?.redraw();
  }

  listen() {
    let from = /** @type {[number, number] | null} */ (null);
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

  /**
   * The column under a place in CSS px; null where none is near.
   * @param {number} sx
   * @param {number} sy
   */
  nearest(sx, sy) {
    const { view } = this;
    let best = /** @type {Row | null} */ (null);
    if (!view) return best;
    let least = Math.max(REACH_PX, this.discPx(view)) ** 2;
    for (const row of this.shown.rows) {
      const at = view.toScreen(row.x, row.y), away = (at.x - sx) ** 2 + (at.y - sy) ** 2;
      if (away < least) [best, least] = [row, away];
    }
    return best;
  }

  /** @param {ImageView} view */
  discPx(view) { return Math.min(13, Math.max(3.5, this.radius * view.scale)); }

  /**
   * @param {ImageView} view
   * @param {Pointed | null} point
   */
  hover(view, point) {
    const row = point && this.nearest(point.sx, point.sy);
    if (row !== this.over) {
      this.over = row;
      this.element.toggleAttribute("data-over", Boolean(row));
      view.redraw();
    }
    this.tip.hidden = !row;
    if (!row) return;
    const [title, ...lines] = this.options.describe(row);
    this.tip.replaceChildren(h("b", {}, title), ...lines.map((line) => h("div", {}, line)));
    const at = view.toScreen(row.x, row.y), { size } = view;
    this.tip.style.left = at.x > size.width / 2 ? "auto" : `${at.x + 16}px`;
    this.tip.style.right = at.x > size.width / 2 ? `calc(100% - ${at.x - 16}px)` : "auto";
    this.tip.style.top = `${Math.min(Math.max(at.y - 20, 4), Math.max(4, size.height - this.tip.offsetHeight - 4))}px`;
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {ImageView} view
   */
  draw(pen, view) {
    const radius = this.discPx(view), { rows, colourOf, chosen, picked, layer } = this.shown;
    for (const row of rows) {
      const { x, y } = view.toScreen(row.x, row.y), colour = colourOf(row), faint = picked && !picked.has(row.column_id);
      pen.globalAlpha = faint ? 0.22 : 1;
      pen.beginPath();
      pen.arc(x, y, layer ? Math.min(radius, 3) : radius, 0, 2 * Math.PI);
      if (colour) {
        pen.fillStyle = colour;
        pen.fill();
      }
      for (const [width, style] of colour ? KNOWN_EDGE : UNKNOWN_EDGE) {
        pen.lineWidth = width;
        pen.strokeStyle = style;
        pen.stroke();
      }
    }
    pen.globalAlpha = 1;
    layer?.(pen);
    for (const row of rows) {
      const own = chosen.get(row.column_id), at = view.toScreen(row.x, row.y);
      if (own) this.ring(pen, at, radius + 4, own, String(row.column_id));
      else if (row === this.over) this.ring(pen, at, radius + 3, "#fff", "");
    }
  }

  /**
   * @param {CanvasRenderingContext2D} pen
   * @param {Point} place in CSS px
   * @param {number} radius
   * @param {string} colour
   * @param {string} text
   */
  ring(pen, { x, y }, radius, colour, text) {
    for (const [width, style] of /** @type {[number, string][]} */ ([[5, "rgb(0 0 0 / 65%)"], [2.8, colour]])) {
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

/**
 * The median distance to the nearest neighbour, px, of some of the columns.
 * @param {Row[]} rows
 */
function spacing(rows) {
  const some = rows.slice(0, 200);
  const nearest = some.map((one) => Math.min(...rows.filter((other) => other !== one).map((other) => Math.hypot(other.x - one.x, other.y - one.y))));
  const known = nearest.filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[known.length >> 1] : 20;
}
