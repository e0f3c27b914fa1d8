// A movie before it is measured: a frame at any zoom, its contrast, and time to scrub through.

import { get, toast, url } from "./api.js";
import { Contrast } from "./contrast.js";
import { h, setAttribute, setText } from "./dom.js";
import { count, duration } from "./format.js";
import { ImageView } from "./image_view.js";

/** @import { Movie } from "./api.js" */

const PLAY_MS = 80; // between frames, at least

export class MoviePreview {
  /** @param {HTMLElement} element */
  constructor(element) {
    /** @type {Movie | null} */
    this.about = null; // the movie that is shown
    /** @type {Record<string, any>} */
    this.reading = {};
    this.frames = this.frame = this.asked = this.settling = this.timer = 0;
    this.playing = false;
    /** @type {ImageView | null} */
    this.view = null;
    this.image = h("div", { class: "image", role: "img", "aria-label": "A frame of the movie: drag to move, wheel to zoom" });
    this.slider = h("input", { type: "range", min: 0, value: 0, step: 1, "aria-label": "Frame", oninput: () => this.go(Number(this.slider.value)) });
    this.place = h("output", {});
    this.play = h("button", { type: "button", class: "icon", "aria-label": "Play", title: "Play", onclick: () => this.togglePlay() }, "▶");
    const contrast = h("div", {});
    this.contrast = new Contrast(contrast, { onChange: () => this.view?.reload() });
    element.replaceChildren(this.image, h("div", { class: "scrub" }, this.play, this.slider, this.place), contrast);
    this.image.addEventListener("keydown", (event) => {
      const step = { ",": -1, ".": 1, PageUp: -10, PageDown: 10 }[event.key];
      if (!step) return;
      event.preventDefault();
      this.go(this.frame + step);
    });
  }

  /**
   * Show a movie: `about` as the API tells it, `reading` the parameters of a raw file.
   * @param {Movie} about
   */
  show(about, reading = {}) {
    const [frames, height, width] = about.shape;
    [this.about, this.reading, this.frames, this.frame, this.playing] = [about, reading, frames, 0, false];
    this.contrast.chosen = null;
    this.slider.max = String(frames - 1);
    this.view?.close();
    this.view = null;
    this.showPlace();
    this.readLevels().then(() => {
      if (this.about !== about) return;
      this.view = new ImageView(this.image, {
        width, height, pixelSizePm: about.pixel_size_pm,
        url: (box, wide) => url("/files/frame.png", { ...this.query(), box: [box.x0, box.y0, box.x1, box.y1].join(), width: wide, low: this.contrast.value?.[0], high: this.contrast.value?.[1] }),
        onPicture: () => this.pictureCame(),
        onError: (error) => { this.stop(); toast(error); },
      });
    }).catch((error) => toast(error));
  }

  /**
   * Take another pixel size for the scale bar.
   * @param {number | null} pixelSizePm
   */
  setPixelSize(pixelSizePm) {
    if (this.about) this.view?.setImage({ width: this.about.shape[2], height: this.about.shape[1], pixelSizePm });
  }

  query() { return { path: this.about?.path, frame: this.frame, ...this.reading }; }

  async readLevels() {
    const { about, frame } = this;
    const levels = await get("/files/histogram", this.query());
    if (this.about === about && this.frame === frame) this.contrast.setLevels(levels);
  }

  /** @param {number} frame */
  go(frame) {
    this.frame = Math.min(Math.max(frame, 0), this.frames - 1);
    this.slider.value = String(this.frame);
    this.showPlace();
    this.view?.reload();
    clearTimeout(this.settling);
    this.settling = setTimeout(() => { if (!this.playing) this.readLevels().catch(() => {}); }, 250);
  }

  showPlace() {
    const step = this.about?.time_stamps ? null : this.about?.frame_time_s;
    const text = `Frame ${count(this.frame)} of 0–${count(this.frames - 1)}${step ? ` · ${duration(this.frame * step)}` : ""}`;
    setText(this.place, text);
    setAttribute(this.slider, "aria-valuetext", text);
  }

  togglePlay() {
    if (this.playing) { this.stop(); return; }
    this.playing = true;
    this.showPlaying();
    this.next();
  }

  stop() {
    this.playing = false;
    this.showPlaying();
    if (this.about) this.readLevels().catch(() => {});
  }

  showPlaying() {
    setText(this.play, this.playing ? "❚❚" : "▶");
    for (const name of ["aria-label", "title"]) setAttribute(this.play, name, this.playing ? "Stop" : "Play");
  }

  next() {
    this.asked = performance.now();
    this.go((this.frame + 1) % this.frames);
  }

  pictureCame() {
    if (!this.playing) return;
    if (document.hidden) { this.stop(); return; }
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.playing && this.next(), Math.max(0, PLAY_MS - (performance.now() - this.asked)));
  }
}
