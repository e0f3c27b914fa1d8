// A picture of a part of an image: loaded, cancelled where it is no longer wanted, and drawn where it belongs.

const CRISP = 2; // device px a pixel, from which on pixels are drawn as squares

/** One picture of a box of the image: the newest that has come, and at most one more on its way. */
export class Picture {
  constructor(view) {
    this.view = view;
    this.clear();
  }

  clear() {
    this.request?.abort();
    this.bitmap?.close();
    this.shown = this.wanted = this.request = this.bitmap = null; // shown, wanted: {box, level}
    this.stale = false;
  }

  get loading() {
    return this.request !== null;
  }

  /** Show a bitmap that is there already. */
  put(bitmap, box) {
    this.bitmap = bitmap;
    this.shown = this.wanted = { box, level: 1 };
    this.stale = false;
  }

  covers(box, level) {
    const mine = this.wanted;
    return (
      !this.stale && mine?.level === level &&
      mine.box.x0 <= box.x0 && mine.box.y0 <= box.y0 && mine.box.x1 >= box.x1 && mine.box.y1 >= box.y1
    );
  }

  /**
   * Load a box, unless it is there or on its way. A request for another box is cancelled; one for the same box, whose
   * picture is to change, may arrive first, so that something moves while a slider is drawn.
   */
  ask(box, level) {
    const same = this.wanted?.level === level && Object.keys(box).every((side) => this.wanted.box[side] === box[side]);
    if (same && !this.stale) return;
    if (same && this.loading) return; // it begins again when that has come
    this.request?.abort();
    this.wanted = { box, level };
    this.#fetch();
  }

  async #fetch() {
    const { wanted, view } = this;
    const request = (this.request = new AbortController());
    this.stale = false;
    let bitmap = null;
    try {
      const { box, level } = wanted;
      const [w, h] = [Math.ceil((box.x1 - box.x0) / level), Math.ceil((box.y1 - box.y0) / level)];
      const edges = { x0: box.x0 - 0.5, y0: box.y0 - 0.5, x1: box.x1 - 0.5, y1: box.y1 - 0.5 };
      const answer = await fetch(view.options.url(edges, w, h), { signal: request.signal });
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
    if (this.stale) this.#fetch();
    view.redraw();
  }

  draw(context) {
    if (!this.bitmap) return;
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
