// What each worker does, and how much of its memory it holds.

import { h, setAttribute, setText } from "./dom.js";
import { bytes, percent, STAGES } from "./format.js";

const HIGH = 0.8; // of the limit: distributed begins to write to disk at 0.7, and stops work at 0.8

/**
 * @typedef {object} Worker as the API tells it
 * @property {string} name
 * @property {string} address
 * @property {number} cpu percent of one processor
 * @property {number} memory bytes
 * @property {number | null} memory_limit
 * @property {number} executing tasks
 * @property {keyof typeof STAGES} stage
 * @typedef {{ element: HTMLElement, update: (worker: Worker) => void }} Row
 */

export class Workers {
  /** @param {HTMLElement} element */
  constructor(element) {
    /** @type {Map<string, Row>} */
    this.rows = new Map();
    this.body = h("tbody", {});
    this.empty = h("p", { class: "muted small" }, "No worker is there yet.");
    this.table = h("div", { class: "scroll workers-scroll" }, h("table", { class: "table workers-table" },
      h("thead", {}, h("tr", {}, ...["Worker", "Doing", "Processor", "Memory"].map((title) => h("th", { scope: "col" }, title)))), this.body));
    element.replaceChildren(this.table, this.empty);
    this.show([]);
  }

  /** @param {Worker[]} workers */
  show(workers) {
    const sorted = [...workers].sort((one, other) => one.name.localeCompare(other.name, "en", { numeric: true }));
    for (const [address, { element }] of this.rows) {
      if (!sorted.some((worker) => worker.address === address)) { element.remove(); this.rows.delete(address); }
    }
    sorted.forEach((worker, index) => {
      const one = this.rows.get(worker.address) ?? row(worker);
      this.rows.set(worker.address, one);
      if (this.body.children[index] !== one.element) this.body.insertBefore(one.element, this.body.children[index] ?? null);
      one.update(worker);
    });
    this.empty.hidden = sorted.length > 0;
    this.table.hidden = sorted.length === 0;
  }
}

/**
 * @param {Worker} worker
 * @returns {Row}
 */
function row({ name, address }) {
  const doing = h("td", {}), meters = ["Processor", "Memory"].map((what) => meter(`${what} of worker ${name}`));
  const element = h("tr", {}, h("td", { title: address }, name), doing, ...meters.map((one) => one.element));
  return {
    element,
    update({ cpu, memory, memory_limit: limit, executing, stage }) {
      setText(doing, executing ? `${STAGES[stage] ?? "Working"}${executing > 1 ? ` × ${executing}` : ""}` : "idle");
      setAttribute(doing, "class", executing ? "" : "muted");
      meters[0].update(cpu / 100, percent(cpu / 100, 0));
      meters[1].update(limit ? memory / limit : 0, limit ? `${bytes(memory)} of ${bytes(limit)}` : bytes(memory), limit && memory / limit > HIGH ? "warn" : "");
    },
  };
}

/** @param {string} label */
function meter(label) {
  const text = h("span", { class: "tabular" }), fill = h("span", {});
  const bar = h("div", { class: "bar", role: "meter", "aria-label": label, "aria-valuemin": 0, "aria-valuemax": 100 }, fill);
  return {
    element: h("td", { class: "meter" }, text, bar),
    /**
     * @param {number} share
     * @param {string} words
     */
    update(share, words, kind = "") {
      setText(text, words);
      setAttribute(bar, "class", `bar ${kind}`);
      setAttribute(bar, "aria-valuenow", Math.round(Math.min(share, 1) * 100));
      fill.style.setProperty("--done", String(Math.min(share, 1)));
    },
  };
}
