// A picture of a part of an image: loaded, cancelled where it is no longer wanted, and drawn where it belongs.

/**
 * @import { Box, ImageView } from "./image_view.js"
 * @typedef {{ box: Box, level: number }} Part
 */

const CRISP = 2; // device px a pixel, from which on pixels are drawn as squares

/** One picture of a box of the image: the newest that has come, and at most one more on its way. */
export class Picture {
  /** @param {ImageView} view */
  constructor(view) {
    this.view = view;
    /** @type {Part | null} */
    this.shown = null;
    /** @type {Part | null} */
    this.wanted = null;
    /** @type {AbortController | null} */
    this.request = null;
    /** @type {ImageBitmap | null} */
    this.bitmap = null;
    this.stale = false;
  }

  clear() {
    this.request?.abort();
    this.bitmap?.close();
    this.shown = this.wanted = this.request = this.bitmap = null;
    this.stale = false;
  }

  get loading() {
    return this.request !== null;
  }

  /**
   * Show a bitmap that is there already.
   * @param {ImageBitmap} bitmap
   * @param {Box} box
   */
  put(bitmap, box) {
    this.bitmap = bitmap;
    this.shown = this.wanted = { box, level: 1 };
    this.stale = false;
  }

  /**
   * @param {Box} box
   * @param {number} level
   */
  covers(box, level) {
    const mine = this.wanted;
    return (
      !this.stale && mine !== null && mine.level === level &&
      mine.box.x0 <= box.x0 && mine.box.y0 <= box.y0 && mine.box.x1 >= box.x1 && mine.box.y1 >= box.y1
    );
  }

  /**
   * Load a box, unless it is there or on its way. A request for another box is cancelled; one for the same box, whose
   * picture is to change, may arrive first, so that something moves while a slider is drawn.
   * @param {Box} box
   * @param {number} level
   */
  ask(box, level) {
    const before = this.wanted;
    const same = before?.level === level && Object.keys(box).every((side) => before.box[side] === box[side]);
    if (same && !this.stale) return;
    if (same && this.loading) return; // it begins again when that has come
    this.request?.abort();
    this.#fetch(this.wanted = { box, level });
  }

  /** @param {Part} wanted */
  async #fetch(wanted) {
    const { view } = this, { url } = view.options;
    if (!url) return;
    const request = (this.request = new AbortController());
    this.stale = false;
    let bitmap = /** @type {ImageBitmap | null} */ (null);
    try {
      const { box, level } = wanted;
      const [w, h] = [Math.ceil((box.x1 - box.x0) / level), Math.ceil((box.y1 - box.y0) / level)];
      const edges = { x0: box.x0 - 0.5, y0: box.y0 - 0.5, x1: box.x1 - 0.5, y1: box.y1 - 0.5 };
      const answer = await fetch(url(edges, w, h), { signal: request.signal });
      if (!answer.ok) throw new Error(`The picture could not be loaded (${answer.status} ${answer.statusText}).`);
      bitmap = await createImageBitmap(await answer.blob());
    } catch (error) {
      if (request.signal.aborted) return;
      view.options.onError?.(error);
    }
    if (request.signal.aborted) {
      bitmap?.close();
      return;
    }
    this.request = null;
    if (bitmap) {
      this.bitmap?.close();
      this.bitmap = bitmap;
      this.shown = wanted;
      view.options.onPicture?.(view);
    }
    if (this.stale) this.#fetch(wanted);
    view.redraw();
  }

  draw(context) {
    if (!this.bitmap || !this.shown) return;
    const { box } = this.shown;
    const { view } = this;
    const low = view.toScreen(box.x0 - 0.5, box.y0 - 0.5);
    const size = view.scale * view.ratio;
    context.imageSmoothingEnabled = (size * (box.x1 - box.x0)) / this.bitmap.width < CRISP;
    context.imageSmoothingQuality = "high";
    const [w, h] = [(box.x1 - box.x0) * size, (box.y1 - box.y0) * size];
    context.drawImage(this.bitmap, low.x * view.ratio, low.y * view.ratio, w, h);
  }
}
