// What each worker does, and how much of its memory it holds.

import { h, setAttribute, setText } from "./dom.js";
import { bytes, percent, STAGES } from "./format.js";

const HIGH = 0.8; // of the limit: distributed begins to write to disk at 0.7, and stops work at 0.8

export class Workers {
  constructor(element) {
    this.rows = new Map();
    this.body = h("tbody", {});
    this.empty = h("p", { class: "muted small" }, "No worker is there yet.");
    this.table = h("div", { class: "scroll workers-scroll" }, h("table", { class: "table workers-table" },
      h("thead", {}, h("tr", {}, ...["Worker", "Doing", "Processor", "Memory"].map((title) => h("th", { scope: "col" }, title)))), this.body));
    element.replaceChildren(this.table, this.empty);
    this.show([]);
  }

  show(workers) {
    const sorted = [...workers].sort((one, other) => one.name.localeCompare(other.name, "en", { numeric: true }));
    for (const address of this.rows.keys()) {
      if (!sorted.some((worker) => worker.address === address)) { this.rows.get(address).element.remove(); this.rows.delete(address); }
    }
    sorted.forEach((worker, index) => {
      if (!this.rows.has(worker.address)) this.rows.set(worker.address, row(worker));
      const one = this.rows.get(worker.address);
      if (this.body.children[index] !== one.element) this.body.insertBefore(one.element, this.body.children[index] ?? null);
      one.update(worker);
    });
    this.empty.hidden = sorted.length > 0;
    this.table.hidden = sorted.length === 0;
  }
}

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

function meter(label) {
  const text = h("span", { class: "tabular" }), fill = h("span", {});
  const bar = h("div", { class: "bar", role: "meter", "aria-label": label, "aria-valuemin": 0, "aria-valuemax": 100 }, fill);
  return {
    element: h("td", { class: "meter" }, text, bar),
    update(share, words, kind = "") {
      setText(text, words);
      setAttribute(bar, "class", `bar ${kind}`);
      setAttribute(bar, "aria-valuenow", Math.round(Math.min(share, 1) * 100));
      fill.style.setProperty("--done", Math.min(share, 1));
    },
  };
}
