// The chosen columns in time: three charts with one axis of time, and the same as CSV.

import { get, toast } from "./api.js";
import { lineChart } from "./charts.js";
import { at, h, setText } from "./dom.js";
import { several, significant } from "./format.js";

/**
 * @import { Summary } from "./api.js"
 * @import { Range } from "./chart_scale.js"
 * @typedef {{ column_id: number, frames_per_point: number, frame: number[], accepted: number[], t: number[], [name: string]: any }} Found
 */

export const MOST = 6; // columns at a time: as many as there are colours
const POINTS = 1500;
const HEADER = ["column_id", "frame", "frames", "accepted", "time", "x_px", "x_stderr_px", "y_px", "y_stderr_px", "intensity_counts", "intensity_stderr_counts"];

/**
 * Series of up to MOST columns.
 *
 *   const panel = new SeriesPanel({ job, onRemove: (id) => {} });
 *   panel.choose([5, 7]); panel.reload();   // reload: the same columns, of newer results
 *   panel.colours                            // Map of id to CSS colour
 */
export class SeriesPanel {
  /** @param {{ job: string, onRemove: (id: number) => void }} options */
  constructor({ job, onRemove }) {
    this.job = job;
    this.onRemove = onRemove;
    /** @type {number[]} */
    this.ids = [];
    /** @type {Map<number, number>} */
    this.slots = new Map(); // of colours, by column
    /** @type {Map<number, Found>} */
    this.found = new Map(); // by column
    /** @type {Range | null} */
    this.view = null;
    this.absolute = false;
    /** @type {Found | null} */
    this.whole = null; // a series of all frames: their times
    this.waiting = 0;
    this.unit = this.timeUnit = "";
    const chart = (/** @type {string} */ id, /** @type {string} */ label, /** @type {number} */ height) => lineChart(at(id), {
      label, height, group: "series", empty: "Click a column on the map, or in the table", onRange: (range) => this.zoomed(range),
    });
    this.charts = { x: chart("series-x", "x in time", 146), y: chart("series-y", "y in time", 146), intensity: chart("series-intensity", "Intensity in time", 160) };
    this.lengths = ["Displacement", "Place"].map((text, index) => h("button", { type: "button", "aria-pressed": String(index === 0), onclick: () => this.setAbsolute(index === 1) }, text));
    at("lengths").append(...this.lengths);
    at("copy").addEventListener("click", () => this.copy());
    at("save").addEventListener("click", () => this.save());
  }

  get colours() { return new Map([...this.slots].map(([id, slot]) => [id, `var(--series-${slot})`])); }

  /**
   * Show these columns; one that stays keeps its colour.
   * @param {number[]} ids
   */
  async choose(ids) {
    this.ids = ids.slice(-MOST);
    for (const id of [...this.slots.keys()]) if (!this.ids.includes(id)) { this.slots.delete(id); this.found.delete(id); }
    for (const id of this.ids) {
      if (this.slots.has(id)) continue;
      const taken = new Set(this.slots.values());
      this.slots.set(id, [1, 2, 3, 4, 5, 6].find((slot) => !taken.has(slot)) ?? 1);
    }
    this.list();
    await this.load(this.ids.filter((id) => !this.found.has(id)));
  }

  reload() { return this.load(this.ids); }

  /** @param {number[]} ids */
  async load(ids) {
    const wanted = this.span();
    try {
      /** @type {Found[]} */
      const came = await Promise.all(ids.map((id) => get(`/jobs/${this.job}/results/series/${id}`, { points: POINTS, ...wanted })));
      if (!("start" in wanted)) this.whole = came[0] ?? this.whole;
      for (const one of came) if (this.ids.includes(one.column_id)) this.found.set(one.column_id, one);
    } catch (error) { toast(error); }
    this.draw();
  }

  /** Frames of the part of time that is seen; nothing where all is. */
  span() {
    if (!this.view || !this.whole) return {};
    const [first, last] = this.view, { t, frame, frames_per_point: step } = this.whole;
    const before = t.filter((time) => time < first).length, until = t.filter((time) => time <= last).length;
    return { start: frame[Math.max(0, before - 1)], stop: frame[Math.min(until, frame.length - 1)] + step };
  }

  /** @param {Range | null} range */
  zoomed(range) {
    this.view = range;
    clearTimeout(this.waiting);
    const binned = [...this.found.values()].some((one) => one.frames_per_point > 1);
    if (binned || !range) this.waiting = setTimeout(() => this.reload(), 120);
  }

  /** @param {boolean} absolute */
  setAbsolute(absolute) {
    this.absolute = absolute;
    this.lengths.forEach((button, index) => button.setAttribute("aria-pressed", String((index === 1) === absolute)));
    this.draw();
  }

  /**
   * What the movie is.
   * @param {Summary} summary
   */
  about({ last_time: last, unit, time_unit: timeUnit }) {
    [this.unit, this.timeUnit] = [unit, timeUnit];
    /** @type {Range} */
    const xRange = [0, last || 1];
    for (const chart of Object.values(this.charts)) chart.update({ xRange, formatX: (value) => `${significant(value, 6)} ${timeUnit}` });
  }

  draw() {
    const all = this.ids.flatMap((id) => this.found.get(id) ?? []);
    const lines = (/** @type {string} */ name) => all.map((one) => ({
      name: String(one.column_id), unit: this.unitOf(name), x: one.t, y: one[name], gaps: true, color: this.slots.get(one.column_id),
      low: one[name].map((/** @type {number | null} */ value, /** @type {number} */ index) => beside(value, one[`${name}_stderr`][index], -1)),
      high: one[name].map((/** @type {number | null} */ value, /** @type {number} */ index) => beside(value, one[`${name}_stderr`][index], 1)),
    }));
    for (const axis of ["x", "y"]) {
      const name = this.absolute ? axis : `d${axis}`;
      this.charts[axis].update({ series: lines(name), yLabel: `${axis}${this.absolute ? "" : " from its place in the sum"} (${this.unitOf(name)})` });
    }
    this.charts.intensity.update({ series: lines("intensity"), yLabel: "intensity (counts)", xLabel: `time (${this.timeUnit || "s"})` });
    const step = Math.max(...all.map((one) => one.frames_per_point), 1);
    setText(at("series-said"), all.length ? `${step > 1 ? `Means of ${several(step, "frame")}` : "Accepted fits of single frames"} with their standard errors (bands). Drag to zoom, double-click for all.` : "");
    for (const id of ["copy", "save"]) at(id, HTMLButtonElement).disabled = !all.length;
  }

  /** @param {string} name */
  unitOf(name) { return name === "intensity" ? "counts" : name.startsWith("d") ? this.unit || "px" : "px"; }

  list() {
    at("chosen").replaceChildren(...this.ids.map((id) => {
      const close = h("button", { type: "button", class: "icon", "aria-label": `Do not show column ${id}`, onclick: () => this.onRemove(id) }, "×");
      const item = h("li", {}, `${id}`, close);
      item.style.setProperty("--own", this.colours.get(id) ?? null);
      return item;
    }));
  }

  csv() {
    const rows = this.ids.flatMap((id) => this.found.get(id) ?? []).flatMap((one) => one.t.map((time, index) => [
      one.column_id, one.frame[index], one.frames_per_point, one.accepted[index], time,
      one.x[index], one.x_stderr[index], one.y[index], one.y_stderr[index], one.intensity[index], one.intensity_stderr[index],
    ].map((value) => value ?? "").join(",")));
    const header = HEADER.map((name) => (name === "time" ? `time_${this.timeUnit}` : name)).join(",");
    return `${[header, ...rows].join("\n")}\n`;
  }

  async copy() {
    try {
      await navigator.clipboard.writeText(this.csv());
      toast(`The series of ${several(this.ids.length, "column")} are on the clipboard`, "good");
    } catch { toast("The browser does not let pages use the clipboard here: save the file instead", "bad"); }
  }

  save() {
    const address = URL.createObjectURL(new Blob([this.csv()], { type: "text/csv" }));
    h("a", { href: address, download: `series-${this.job}-${this.ids.join("-")}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }
}

/** @type {(value: number | null, error: number | null, side: number) => number | null} */
const beside = (value, error, side) => (value === null ? null : error === null ? value : value + side * error);
