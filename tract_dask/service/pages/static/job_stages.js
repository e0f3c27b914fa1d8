// The stages of a run: a list, each with its time as a bar on the line of all of them.

import { h, setAttribute, setText } from "./dom.js";
import { between, count, duration, percent, several, STAGES } from "./format.js";

/**
 * @import { Job, StageRecord } from "./api.js"
 * @typedef {{ name: keyof typeof STAGES, state: string, start: number, seconds: number, record: StageRecord }} Stage
 * @typedef {{ mark: HTMLElement, bar: HTMLElement, time: HTMLElement, summary: HTMLElement, element: HTMLElement }} Row
 */

const MARKS = { pending: "○", running: "●", done: "✓", reused: "✓", failed: "✗" };
const WORDS = { pending: "to come", running: "running", done: "done", reused: "done before", failed: "stopped here" };

/**
 * Where each stage stands on the line of the run's working time, in s.
 * @param {Job} job
 * @returns {Stage[]}
 */
export function timeline(job) {
  let start = 0;
  return /** @type {(keyof typeof STAGES)[]} */ (Object.keys(STAGES)).map((name) => {
    const record = job.progress.stages?.[name] ?? { state: "pending", seconds: null, done_frames: 0 };
    let { state } = record;
    if (state === "running" && job.state !== "running") state = job.state === "failed" ? "failed" : "pending";
    const seconds = state === "running" && record.started ? Math.max(record.seconds ?? 0, between(record.started)) : state === "pending" ? 0 : record.seconds ?? 0;
    const stage = { name, state, start, seconds, record };
    start += seconds;
    return stage;
  });
}

export class Stages {
  /**
   * @param {HTMLElement} element
   * @param {HTMLElement} total
   */
  constructor(element, total) {
    this.total = total;
    /** @type {Map<string, Row>} */
    this.rows = new Map(Object.entries(STAGES).map(([name, title]) => {
      const mark = h("span", { class: "mark", role: "img" }), bar = h("span", {}), time = h("span", { class: "time" }), summary = h("span", { class: "summary" });
      const element = h("div", { class: "stage", role: "listitem", dataset: { stage: name } }, mark, h("span", { class: "stage-name" }, title), h("span", { class: "track" }, bar), time, summary);
      return [name, { mark, bar, time, summary, element }];
    }));
    element.setAttribute("role", "list");
    element.append(...[...this.rows.values()].map((row) => row.element));
  }

  /** @param {Job} job */
  show(job) {
    const stages = timeline(job), whole = Math.max(stages.reduce((sum, stage) => sum + stage.seconds, 0), 0.001);
    for (const { name, state, start, seconds, record } of stages) {
      const row = this.rows.get(name);
      if (!row) continue;
      setAttribute(row.element, "data-state", state);
      setText(row.mark, MARKS[state]);
      setAttribute(row.mark, "aria-label", WORDS[state]);
      row.bar.hidden = !seconds;
      Object.assign(row.bar.style, { left: `${(100 * start) / whole}%`, width: `${(100 * seconds) / whole}%` });
      setText(row.time, state === "pending" ? "" : state === "reused" && !seconds ? "before" : duration(seconds));
      setText(row.summary, state === "running" && record.frames ? `${count(record.done_frames)} of ${several(record.frames, "frame")}, ${percent(record.done_frames / record.frames, 0)}` : record.summary || "");
    }
    setText(this.total, whole > 0.01 ? `${duration(whole)} of work` : "");
  }
}
