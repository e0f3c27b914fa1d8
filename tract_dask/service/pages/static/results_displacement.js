// How far the columns moved from one frame to another, as arrows on the map.

import { get, toast } from "./api.js";
import { at, h, setText } from "./dom.js";
import { significant } from "./format.js";
import { round } from "./results_map.js";

/**
 * @import { Summary } from "./api.js"
 * @import { Row } from "./column_map.js"
 * @import { ResultsMap } from "./results_map.js"
 */

const CERTAIN = 0.01;
const MAGNIFY = [1, 2, 5, 10, 20, 50, 100, 200];
const WAIT_MS = 60;

export class Displacements {
  /** @param {{ job: string, map: ResultsMap, said: HTMLElement }} options */
  constructor({ job, map, said }) {
    this.job = job;
    this.map = map;
    this.said = said;
    this.active = this.known = false;
    this.pixelSize = 1;
    this.waiting = 0;
    this.unit = "";
    /** @type {Map<number, Row>} */
    this.rows = new Map();
    /** @type {AbortController | null} */
    this.request = null;
    /** @type {number | null} */
    this.chosenFactor = null;
    this.form = at("arrows");
    const pairOf = (/** @type {string} */ name) => [name, `${name}-range`].map((id) => at(id, HTMLInputElement));
    this.inputs = { first: pairOf("first"), second: pairOf("second") };
    for (const pair of Object.values(this.inputs)) {
      pair.forEach((input, index) => input.addEventListener("input", () => { pair[1 - index].value = input.value; this.soon(); }));
    }
    this.magnify = at("magnify", HTMLSelectElement);
    this.certain = at("certain", HTMLInputElement);
    this.magnify.addEventListener("change", () => { this.chosenFactor = Number(this.magnify.value); this.draw(); });
    this.certain.addEventListener("change", () => this.draw());
    this.form.addEventListener("submit", (event) => event.preventDefault());
  }

  /**
   * What the movie is; frames are set once.
   * @param {Summary} summary
   */
  about(summary) {
    const last = summary.frames.total - 1;
    this.pixelSize = summary.pixel_size_pm ?? 1;
    for (const [name, pair] of Object.entries(this.inputs)) {
      for (const input of pair) {
        const fresh = input.max === "" || !this.known;
        input.max = String(last);
        if (fresh) input.value = String(name === "first" ? 0 : last);
      }
    }
    this.known = true;
    if (this.active) this.load();
  }

  /** @param {boolean} active */
  activate(active) {
    this.active = active;
    this.form.hidden = !active;
    if (active) this.load();
    else {
      this.rows.clear();
      setText(this.said, "");
      this.map.show({ arrows: null });
    }
  }

  soon() {
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.load(), WAIT_MS);
  }

  async load() {
    const [first, second] = [this.inputs.first[0], this.inputs.second[0]].map((input) => (input.checkValidity() ? input.valueAsNumber : NaN));
    if (Number.isNaN(first) || Number.isNaN(second)) return;
    this.request?.abort();
    const request = (this.request = new AbortController());
    try {
      const answer = await get(`/jobs/${this.job}/results/displacement`, { first, second }, { signal: request.signal });
      if (!this.active) return;
      this.unit = answer.unit;
      this.rows = new Map(answer.columns.map((/** @type {Row} */ row) => [row.column_id, row]));
      this.draw();
    } catch (error) { if (error.name !== "AbortError") toast(error); }
  }

  /** Draw the arrows, so much longer than the displacements that most can be seen. */
  draw() {
    const rows = [...this.rows.values()], known = rows.filter((row) => row.distance !== null);
    const sure = (/** @type {Row} */ row) => row.p_value !== null && row.p_value < CERTAIN;
    const lengths = known.map((row) => row.distance).sort((a, b) => a - b);
    const usual = lengths[Math.floor(0.9 * (lengths.length - 1))] || 1;
    const fitting = round(Math.max(1, (1.2 * this.map.radius * this.pixelSize * 2) / usual));
    const factors = [...new Set([...MAGNIFY, this.chosenFactor ?? fitting])].sort((a, b) => a - b);
    this.magnify.replaceChildren(...factors.map((factor) => h("option", { value: factor }, `× ${factor}`)));
    this.magnify.value = String(this.chosenFactor ?? fitting);
    setText(this.said, known.length ? `${known.filter(sure).length} of ${known.length} columns moved (p < 0.01)` : "No column is accepted in both frames");
    const shown = this.certain.checked ? known.filter(sure) : known;
    this.map.show({ arrows: { rows: shown, factor: Number(this.magnify.value), unit: this.unit || "pm", pixelSize: this.pixelSize, counts: sure } });
  }

  /** @param {number} id */
  describe(id) {
    const row = this.active ? this.rows.get(id) : null;
    if (!row) return "";
    if (row.distance === null) return "not accepted in both frames";
    const p = row.p_value === null ? "" : `, p ${row.p_value < 1e-6 ? "< 0.000001" : significant(row.p_value, 2)}`;
    return `moved ${significant(row.distance)} ${this.unit} (x ${significant(row.dx)} ± ${significant(row.stderr_x, 2)}, y ${significant(row.dy)} ± ${significant(row.stderr_y, 2)})${p}`;
  }
}
