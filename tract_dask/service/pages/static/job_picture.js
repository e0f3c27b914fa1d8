// The picture of a job while it runs: a frame first, then the sum, the columns that were found, and what is known of each.

import { get, toast, url } from "./api.js";
import { ColourBar, drawColumn } from "./colour_scale.js";
import { h, setText } from "./dom.js";
import { percent, significant } from "./format.js";
import { ImageView } from "./image_view.js";
import { scaleOf, viridis } from "./number_colours.js";

/**
 * @import { Levels } from "./api.js"
 * @import { Scale } from "./number_colours.js"
 * @import { Box, Point } from "./image_view.js"
 * @typedef {{ column_id: number, x: number, y: number, kind: string, [name: string]: any }} Column
 * @typedef {object} Places
 * @property {HTMLElement} element
 * @property {HTMLElement} scale
 * @property {HTMLElement} pointed
 * @property {HTMLElement} title
 * @property {HTMLSelectElement} select
 */

const AGAIN_MS = 1500;
const TRIES = 5; // a store that was just written may not be seen at once
const CLICK_PX = 4;
const HIT_PX = 14;

export class JobPicture {
  /**
   * @param {Places} places
   * @param {string} job its id; `pixelSizePm` is set where its settings have one
   */
  constructor({ element, scale, pointed, title, select }, job) {
    this.element = element;
    this.pointed = pointed;
    this.title = title;
    this.select = select;
    this.job = job;
    /** @type {number | null} */
    this.pixelSizePm = null;
    /** @type {Column[]} */
    this.columns = [];
    /** @type {{ columns: Column[], unit: string } | null} */
    this.values = null;
    /** @type {Column | null} */
    this.under = null; // the pointer
    /** @type {[number, number] | null} */
    this.down = null; // where the pointer was pressed
    /** @type {Scale | null} */
    this.colours = null;
    /** @type {ImageView | null} */
    this.view = null;
    this.shown = "";
    this.spacing = 40;
    this.hint = h("div", { class: "hint" }, "Reading …");
    this.element.append(this.hint);
    this.bar = new ColourBar(scale);
    this.select.addEventListener("change", () => this.colour());
    this.element.addEventListener("pointerdown", (event) => { this.down = [event.clientX, event.clientY]; });
    this.element.addEventListener("click", (event) => this.clicked(event));
    this.colour();
  }

  /** Show a frame of the movie, until there is a sum. */
  async showFrame() {
    if (this.shown) return;
    await this.load("frame", `/jobs/${this.job}/histogram`, `/jobs/${this.job}/frame.png`, { frame: 0 }, "First frame");
  }

  /** Show the summed image; a frame where there is none any more. */
  async showSum(tries = TRIES) {
    if (this.shown.startsWith("sum")) return;
    await this.load("sum", `/jobs/${this.job}/sum`, `/jobs/${this.job}/sum.png`, {}, "Sum of the frames");
    if (this.shown.startsWith("sum")) return;
    if (tries > 1) setTimeout(() => this.showSum(tries - 1), AGAIN_MS);
    else await this.showFrame();
  }

  /**
   * @param {string} kind
   * @param {string} about
   * @param {string} picture
   * @param {Record<string, any>} query
   * @param {string} title
   */
  async load(kind, about, picture, query, title) {
    /** @type {Levels & { version: string, shape: [number, number], pixel_size_pm: number | null }} */
    let levels;
    try { levels = await get(about, query); } catch (error) {
      if (error.status !== 404 || kind === "frame") setText(this.hint, error.what || "The picture cannot be shown");
      return;
    }
    if (!levels.percentiles || (kind === "frame" && this.shown)) return;
    this.shown = `${kind} ${levels.version}`;
    setText(this.title, title);
    this.hint.hidden = true;
    const contrast = { low: levels.percentiles["0.5"], high: levels.percentiles["99.5"] };
    if (contrast.low === contrast.high && levels.range) Object.assign(contrast, { low: levels.range[0], high: levels.range[1] });
    const [height, width] = levels.shape;
    const address = (/** @type {Box} */ box, /** @type {number} */ wide) => url(picture, { ...query, ...contrast, v: levels.version, box: [box.x0, box.y0, box.x1, box.y1].join(), width: wide });
    const image = { width, height, pixelSizePm: this.pixelSizePm ?? levels.pixel_size_pm };
    if (this.view) {
      this.view.options.url = address;
      this.view.setImage(image);
    } else {
      this.view = new ImageView(this.element, { ...image, url: address, onDraw: (pen, view) => this.draw(pen, view), onHover: (point) => this.hover(point), onError: (error) => toast(error) });
    }
  }

  /** Show the columns that will be fitted, or are. */
  async showColumns(version) {
    try {
      const found = await get(`/jobs/${this.job}/columns/${version ?? 0}`);
      if (this.values) return;
      this.columns = found.columns;
      this.spacing = found.spacing_px ?? this.spacing;
      this.view?.redraw();
    } catch (error) { if (error.status !== 404) toast(error); }
  }

  /** Show what the finished shards say of each column: the answer of GET /jobs/ID/results/columns. */
  showValues(found) {
    this.values = found;
    this.columns = found.columns;
    this.colour();
  }

  /** Back to the columns without values, as another try begins. */
  forget() {
    [this.values, this.columns, this.shown] = [null, [], ""];
    this.colour();
  }

  colour() {
    const by = this.select.value, unit = this.values?.unit ?? "";
    const values = this.values ? this.columns.map((one) => one[by]) : [];
    this.colours = by === "sd" || !this.values ? scaleOf(values) : shareScale(values);
    this.select.disabled = !this.values;
    this.bar.show(this.colours, by === "sd" ? (value) => `${significant(value, 2)} ${unit}` : (value) => percent(value, 0));
    this.view?.redraw();
  }

  draw(pen, view) {
    const radius = Math.min(Math.max(this.spacing * 0.2 * view.scale, 3), 13);
    for (const one of this.columns) {
      const value = this.values ? one[this.select.value] : null;
      const colour = value === null || value === undefined || !this.colours ? "" : this.colours.colour(value);
      drawColumn(pen, view.toScreen(one.x, one.y), one === this.under ? radius + 2.5 : radius, colour);
    }
  }

  /** @param {Point | null} point */
  hover(point) {
    const found = point && this.nearest(point);
    if (found !== this.under) {
      this.under = found;
      this.element.toggleAttribute("data-on-column", Boolean(found && this.values));
      this.view?.redraw();
    }
    setText(this.pointed, found ? this.describe(found) : "");
  }

  /** @param {Point} point */
  nearest(point) {
    let best = /** @type {Column | null} */ (null), least = HIT_PX / (this.view?.scale ?? 1);
    for (const one of this.columns) {
      const away = Math.hypot(one.x - point.x, one.y - point.y);
      if (away < least) [best, least] = [one, away];
    }
    return best;
  }

  /** @param {Column} one */
  describe(one) {
    const parts = [`Column ${one.column_id}${one.kind ? ` (${one.kind})` : ""}`];
    if (this.values) {
      if (one.sd !== null) parts.push(`sd ${significant(one.sd, 3)} ${this.values.unit}`);
      if (one.accepted_share !== null) parts.push(`${percent(one.accepted_share)} of ${one.fits} fits accepted`);
    }
    return parts.join(" · ");
  }

  clicked(event) {
    const moved = this.down ? Math.hypot(event.clientX - this.down[0], event.clientY - this.down[1]) : Infinity;
    if (this.values && this.under && moved < CLICK_PX) location.assign(`/jobs/${this.job}/results#columns=${this.under.column_id}`);
  }
}

/**
 * A scale for shares: its end is 1, so that all that is accepted looks the same in every job.
 * @param {(number | null)[]} values
 * @returns {Scale}
 */
function shareScale(values) {
  const low = Math.min(0.5, ...values.filter((value) => value !== null));
  return { low, high: 1, more: false, colour: (value) => viridis((value - low) / (1 - low)) };
}
