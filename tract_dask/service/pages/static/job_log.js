// The log of a job: its lines and the changes of its state, newest first.

import { h } from "./dom.js";
import { fullTime, timeOfDay, STATES } from "./format.js";

const MOST = 500;

export class Log {
  /** @param {HTMLElement} element */
  constructor(element) {
    this.element = element;
    /** @type {string[]} */
    this.times = []; // of what is shown, newest first
  }

  /**
   * A line as the API tells it.
   * @param {{ time: string, level: string, message: string }} line
   */
  add({ time, level, message }) { this.put(time, level, h("span", {}, message)); }

  /**
   * A change of state.
   * @param {{ time: string, state: string, reason: string }} change
   */
  addTransition({ time, state, reason }) {
    this.put(time, state === "failed" ? "error" : "info", h("span", {}, h("b", { class: "state" }, STATES[state]), reason ? `: ${reason}` : ""));
  }

  /**
   * @param {string} time
   * @param {string} level
   * @param {HTMLElement} text
   */
  put(time, level, text) {
    const at = this.times.findIndex((other) => other <= time), index = at < 0 ? this.times.length : at;
    this.times.splice(index, 0, time);
    const line = h("li", { dataset: { level } }, h("time", { datetime: time, title: fullTime(time) }, timeOfDay(time)), text);
    this.element.insertBefore(line, this.element.children[index] ?? null);
    if (this.times.length > MOST) { this.times.pop(); this.element.lastChild?.remove(); }
  }
}
