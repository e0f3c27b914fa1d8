/**
 * An image of any size in an element: zoom, pan, pinch, scale bar, and a layer to draw on in image coordinates.
 *
 * Coordinates are those of the whole project: an integer is a pixel's centre, x to the right, y down. So an image of
 * `width` columns reaches from -0.5 to width - 0.5. The box that `url` is given, {x0, y0, x1, y1}, are such edges, always
 * between pixels; the picture of it is `w` by `h`, neither above 2048, and covers the box exactly.
 *
 *   const view = new ImageView(element, {
 *     width: 576, height: 512,                  // of the image, px
 *     url: (box, w, h) => `/api/v1/...png?box=${box.x0},${box.y0},${box.x1},${box.y1}&width=${w}`,
 *     picture: { bitmap, width, height },       // in place of `url`: the whole image, and how many of its px the bitmap covers
 *     pixelSizePm: 4,                           // for the scale bar; null: px
 *     onDraw: (ctx, view) => {},                // in CSS px, after view.toScreen(x, y); whenever something moved
 *     onHover: (point, event) => {},            // {x, y} in image coordinates, null when the pointer has left
 *     onView: (view) => {},                     // the visible part has changed
 *     onError: (error) => {},                   // a picture could not be loaded (the old one stays)
 *     onPicture: (view) => {},                  // a picture has come
 *     gesture: (point, event) => null,          // pointer is down: {move(point, event), end(...), cancel()} takes the drag
 *     onDoubleClick: (point, event) => false,   // true: taken, otherwise the view fits the image
 *   });
 *   view.reload()                               // `url` now gives other pictures (contrast, frame): old ones stay until then
 *   view.setImage({width, height, pixelSizePm}) // another image
 *   view.redraw(); view.fit(); view.zoom(factor, screenPoint); view.center(x, y, scale); view.close()
 *   view.toScreen(x, y) -> {x, y} CSS px in the element; view.toImage(sx, sy) -> {x, y}; view.scale (CSS px a pixel)
 *   view.visible() -> {x0, y0, x1, y1} coordinates; view.loaded (whether what is shown is what is wanted)
 *
 * @typedef {{ x: number, y: number }} Point
 * @typedef {{ x: number, y: number, sx: number, sy: number }} Pointed a place in the image, and in the element
 * @typedef {{ x0: number, y0: number, x1: number, y1: number }} Box
 * @typedef {{ width: number, height: number, pixelSizePm?: number | null }} Image
 * @typedef {{ bitmap: ImageBitmap, width: number, height: number }} WholePicture
 * @typedef {{ move?: (point: Pointed, event: PointerEvent) => void, end?: (point: Pointed, event: PointerEvent) => void, cancel?: () => void }} Gesture
 * @typedef {object} Behaviour
 * @property {(box: Box, w: number, h: number) => string} [url]
 * @property {WholePicture} [picture]
 * @property {(pen: CanvasRenderingContext2D, view: ImageView) => void} [onDraw]
 * @property {(point: Pointed | null, event: PointerEvent) => void} [onHover]
 * @property {(view: ImageView) => void} [onView]
 * @property {(error: Error) => void} [onError]
 * @property {(view: ImageView) => void} [onPicture]
 * @property {(point: Pointed, event: PointerEvent) => Gesture | null | undefined} [gesture]
 * @property {(point: Pointed, event: MouseEvent) => boolean} [onDoubleClick]
 * @typedef {Image & Behaviour} ImageOptions
 */

import { penOf } from "./dom.js";
import { Picture } from "./image_picture.js";
import { drawScaleBar } from "./scale_bar.js";

const WHOLE = 2 ** 21; // a picture of the whole image has no more px than this
const LONGEST = 2048; // side of a picture
const MARGIN = 0.3; // of the visible box, loaded beyond it on each side
const FINEST = 64; // CSS px a pixel
const WAIT_MS = 70; // after a movement, before a sharper picture is asked for

export class ImageView {
  /**
   * @param {HTMLElement} element
   * @param {ImageOptions} options
   */
  constructor(element, options) {
    this.element = element;
    this.options = options;
    this.width = this.height = 0;
    /** @type {number | null} */
    this.pixelSizePm = null;
    this.scale = this.ratio = 1;
    this.fitted = true;
    this.middle = { x: 0, y: 0 };
    this.size = { width: 0, height: 0 };
    this.whole = new Picture(this);
    this.detail = new Picture(this);
    /** @type {Map<number, Pointed>} */
    this.pointers = new Map();
    /** @type {Gesture | null} */
    this.drag = null;
    this.frame = this.waiting = 0; // of what is to be drawn, and loaded
    this.stopping = new AbortController();
    this.#dress();
    this.canvas = this.#layer("picture");
    this.overlay = this.#layer("overlay");
    this.watcher = new ResizeObserver(() => this.#sized());
    this.themes = new MutationObserver(() => this.redraw());
    this.#listen();
    this.setImage(options);
  }

  /**
   * Show another image, or the same at another size.
   * @param {Image} image
   */
  setImage({ width, height, pixelSizePm = this.pixelSizePm }) {
    const same = width === this.width && height === this.height;
    [this.width, this.height, this.pixelSizePm] = [width, height, pixelSizePm ?? null];
    if (!same) {
      this.whole.clear();
      this.detail.clear();
      this.#resize();
      this.fit();
    }
    this.reload();
  }

  /** Ask for the pictures anew; those there stay until the new ones have come. */
  reload() {
    this.whole.stale = this.detail.stale = true;
    this.#load();
    this.redraw();
  }

  /** Show the whole image. */
  fit() {
    this.fitted = true;
    this.scale = this.#fitting();
    this.middle = { x: (this.width - 1) / 2, y: (this.height - 1) / 2 };
    this.#moved();
  }

  /** Zoom by `factor`, keeping what is at `at` (CSS px in the element; its middle by default) in its place. */
  zoom(factor, at = { x: this.size.width / 2, y: this.size.height / 2 }) {
    const held = this.toImage(at.x, at.y);
    const least = Math.min(0.5 * this.#fitting(), 1);
    this.scale = Math.min(FINEST, Math.max(least, this.scale * factor));
    this.middle = {
      x: held.x - (at.x - this.size.width / 2) / this.scale,
      y: held.y - (at.y - this.size.height / 2) / this.scale,
    };
    this.fitted = false;
    this.#moved();
  }

  /** Put (x, y) of the image into the middle. */
  center(x, y, scale = this.scale) {
    this.scale = Math.min(FINEST, scale);
    this.middle = { x, y };
    this.fitted = false;
    this.#moved();
  }

  /** Move what is shown by CSS px. */
  pan(dx, dy) {
    this.center(this.middle.x - dx / this.scale, this.middle.y - dy / this.scale);
  }

  toScreen(x, y) {
    return {
      x: (x - this.middle.x) * this.scale + this.size.width / 2,
      y: (y - this.middle.y) * this.scale + this.size.height / 2,
    };
  }

  toImage(sx, sy) {
    return {
      x: (sx - this.size.width / 2) / this.scale + this.middle.x,
      y: (sy - this.size.height / 2) / this.scale + this.middle.y,
    };
  }

  /** What can be seen, in coordinates of the image; it may reach beyond it. */
  visible() {
    const [low, high] = [this.toImage(0, 0), this.toImage(this.size.width, this.size.height)];
    return { x0: low.x, y0: low.y, x1: high.x, y1: high.y };
  }

  get loaded() {
    return !this.whole.stale && !this.detail.stale && !this.whole.loading && !this.detail.loading && !this.waiting;
  }

  /** Draw in the next animation frame. */
  redraw() {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.draw();
    });
  }

  /** Let go of everything. */
  close() {
    this.stopping.abort();
    this.watcher.disconnect();
    this.themes.disconnect();
    this.whole.clear();
    this.detail.clear();
    cancelAnimationFrame(this.frame);
    clearTimeout(this.waiting);
    this.canvas.remove();
    this.overlay.remove();
  }

  #dress() {
    const { style } = this.element;
    if (getComputedStyle(this.element).position === "static") style.position = "relative";
    style.overflow = "hidden";
    style.touchAction = "none";
    style.userSelect = "none";
    if (!this.element.hasAttribute("tabindex")) this.element.tabIndex = 0;
  }

  #layer(name) {
    const canvas = document.createElement("canvas");
    canvas.className = name;
    canvas.setAttribute("aria-hidden", "true");
    Object.assign(canvas.style, { position: "absolute", inset: "0", width: "100%", height: "100%", pointerEvents: "none" });
    return this.element.appendChild(canvas);
  }

  #listen() {
    const { signal } = this.stopping;
    const on = (name, heard, more = {}) => this.element.addEventListener(name, heard, { signal, ...more });
    on("wheel", (event) => this.#onWheel(event), { passive: false });
    on("pointerdown", (event) => this.#onDown(event));
    on("pointermove", (event) => this.#onMove(event));
    on("pointerup", (event) => this.#onUp(event));
    on("pointercancel", (event) => this.#onUp(event));
    on("pointerleave", (event) => this.options.onHover?.(null, event));
    on("dblclick", (event) => this.options.onDoubleClick?.(this.#point(event), event) || this.fit());
    on("keydown", (event) => this.#onKey(event));
    this.watcher.observe(this.element);
    this.themes.observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme", "class"] });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw(), { signal });
  }

  #sized() {
    this.#resize();
    if (this.fitted) this.fit();
    else this.#moved();
  }

  #fitting() {
    const { width, height } = this.size;
    return Math.max(1e-3, Math.min((width - 8) / this.width, (height - 8) / this.height));
  }

  #resize() {
    this.size = { width: Math.max(1, this.element.clientWidth), height: Math.max(1, this.element.clientHeight) };
    this.ratio = window.devicePixelRatio || 1;
    for (const canvas of [this.canvas, this.overlay]) {
      canvas.width = Math.round(this.size.width * this.ratio);
      canvas.height = Math.round(this.size.height * this.ratio);
    }
  }

  #moved() {
    this.middle.x = Math.min(this.width - 0.5, Math.max(-0.5, this.middle.x));
    this.middle.y = Math.min(this.height - 0.5, Math.max(-0.5, this.middle.y));
    this.redraw();
    this.options.onView?.(this);
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => {
      this.waiting = 0;
      this.#load();
    }, WAIT_MS);
  }

  /** The place of a pointer: image coordinates, and CSS px in the element (sx, sy). */
  #point(event) {
    const frame = this.element.getBoundingClientRect();
    const sx = event.clientX - frame.left - this.element.clientLeft;
    const sy = event.clientY - frame.top - this.element.clientTop;
    return { ...this.toImage(sx, sy), sx, sy };
  }

  #onWheel(event) {
    event.preventDefault();
    const { sx, sy } = this.#point(event);
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    const turned = Math.max(-300, Math.min(300, event.deltaY * lines));
    this.zoom(2 ** (-turned / (event.ctrlKey ? 60 : 240)), { x: sx, y: sy }); // ctrlKey: a pinch on a touchpad
  }

  #onDown(event) {
    this.element.focus({ preventScroll: true });
    const point = this.#point(event);
    this.pointers.set(event.pointerId, point);
    this.element.setPointerCapture(event.pointerId);
    if (this.pointers.size === 2) {
      this.drag?.cancel?.();
      this.drag = null;
    } else if (this.pointers.size === 1) {
      const taken = event.button === 0 && this.options.gesture?.(point, event);
      this.drag = taken || this.#panning(point);
      if (event.button === 1) event.preventDefault();
    }
  }

  #panning(start) {
    let last = start;
    this.element.dataset.panning = "";
    const end = () => delete this.element.dataset.panning;
    const move = (point) => {
      this.pan(point.sx - last.sx, point.sy - last.sy);
      last = point;
    };
    return { move, end, cancel: end };
  }

  #onMove(event) {
    const point = this.#point(event);
    if (this.pointers.size === 2 && this.pointers.has(event.pointerId)) this.#pinch(event.pointerId, point);
    if (this.pointers.has(event.pointerId)) this.pointers.set(event.pointerId, point);
    this.drag?.move?.(point, event);
    this.options.onHover?.(point, event);
  }

  #pinch(id, point) {
    const [other] = [...this.pointers].filter(([pointer]) => pointer !== id).map(([, place]) => place);
    const before = this.pointers.get(id) ?? point;
    const apart = (place) => Math.max(8, Math.hypot(place.sx - other.sx, place.sy - other.sy));
    this.pan((point.sx - before.sx) / 2, (point.sy - before.sy) / 2);
    this.zoom(apart(point) / apart(before), { x: (point.sx + other.sx) / 2, y: (point.sy + other.sy) / 2 });
  }

  #onUp(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    const drag = this.drag;
    this.drag = null;
    if (event.type === "pointercancel") drag?.cancel?.();
    else drag?.end?.(this.#point(event), event);
  }

  #onKey(event) {
    if (event.target !== this.element || event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const step = event.shiftKey ? 200 : 60;
    const act = {
      "+": () => this.zoom(1.5),
      "=": () => this.zoom(1.5),
      "-": () => this.zoom(1 / 1.5),
      0: () => this.fit(),
      ArrowLeft: () => this.pan(step, 0),
      ArrowRight: () => this.pan(-step, 0),
      ArrowUp: () => this.pan(0, step),
      ArrowDown: () => this.pan(0, -step),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  /** Ask for what is needed and not there: the whole image, and the visible box where that is not fine enough. */
  #load() {
    const { picture } = this.options;
    if (picture) {
      this.whole.put(picture.bitmap, { x0: 0, y0: 0, x1: picture.width, y1: picture.height });
      this.detail.stale = false;
      return;
    }
    const least = Math.max(Math.sqrt((this.width * this.height) / WHOLE), Math.max(this.width, this.height) / LONGEST);
    const coarse = powerOfTwo(2 * least * (1 - 1e-6)); // px of the image to a px of the picture
    this.whole.ask({ x0: 0, y0: 0, x1: this.width, y1: this.height }, coarse);
    let level = powerOfTwo(1 / (this.scale * this.ratio));
    const { x0, y0, x1, y1 } = this.visible();
    const [across, down] = [Math.min(this.width, x1 - x0), Math.min(this.height, y1 - y0)];
    while (Math.max(across, down) > (LONGEST - 2) * level) level *= 2;
    if (level >= coarse) {
      this.detail.clear();
      this.redraw();
      return;
    }
    if (this.detail.covers(this.#box(x0, y0, x1, y1, level), level)) return;
    const [dx, dy] = [across, down].map((side) => Math.min(MARGIN * side, ((LONGEST - 2) * level - side) / 2));
    this.detail.ask(this.#box(x0 - dx, y0 - dy, x1 + dx, y1 + dy, level), level);
  }

  /** The pixels between coordinates, x1 and y1 not included: at multiples of `level`, but for the image's edge. */
  #box(x0, y0, x1, y1, level) {
    const low = (value, limit) => Math.min(limit - 1, Math.max(0, Math.floor((value + 0.5) / level) * level));
    const high = (value, limit) => Math.max(1, Math.min(limit, Math.ceil((value + 0.5) / level) * level));
    return { x0: low(x0, this.width), y0: low(y0, this.height), x1: high(x1, this.width), y1: high(y1, this.height) };
  }

  /** Draw now; `redraw` does it once a frame. */
  draw() {
    const context = penOf(this.canvas);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    for (const picture of [this.whole, this.detail]) picture.draw(context);
    const overlay = penOf(this.overlay);
    overlay.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    overlay.clearRect(0, 0, this.size.width, this.size.height);
    this.#outline(overlay);
    this.options.onDraw?.(overlay, this);
    drawScaleBar(overlay, this);
    this.element.toggleAttribute("data-loading", !this.loaded);
  }

  #outline(context) {
    const low = this.toScreen(-0.5, -0.5);
    context.strokeStyle = getComputedStyle(this.element).getPropertyValue("--line").trim() || "#888";
    context.lineWidth = 1;
    context.strokeRect(low.x - 0.5, low.y - 0.5, this.width * this.scale + 1, this.height * this.scale + 1);
  }
}

/** The largest power of two that is no larger than `value`, and 1 at least. */
function powerOfTwo(value) {
  return 2 ** Math.max(0, Math.floor(Math.log2(value) + 1e-9));
}
