// The settings of a job as fields, made from their declarations; what is not changed has its default.

import { h, setAttribute, setText } from "./dom.js";

/**
 * @typedef {object} Declared a setting as GET /settings tells it
 * @property {string} group
 * @property {string} title of the group
 * @property {string} name
 * @property {string} type "boolean", "integer", "number", "string" or "array"
 * @property {string | null} items of an array
 * @property {boolean} optional
 * @property {string[]} choices
 * @property {string[]} words that may stand in place of a number
 * @property {string} unit
 * @property {number | null} low
 * @property {number | null} high
 * @property {any} default
 * @property {string} description
 */

/** Settings that matter only beside others: shown where these hold, or where they are changed. */
const ONLY_WITH = {
  "drift.csv": (value) => value("drift.method") === "csv",
  "drift.search_px": (value) => value("drift.method") === "auto",
  "fit.refine_drift": (value) => value("drift.method") !== "none",
  "fit.refine_columns": (value) => value("drift.method") !== "none" && value("fit.refine_drift"),
  "columns.csv": (value) => value("columns.method") === "csv",
  "columns.lattices": (value) => value("columns.method") === "lattice",
  "columns.template": (value) => value("columns.method") === "template",
  "columns.detection_threshold": (value) => ["maxima", "blobs", "template"].includes(value("columns.method")),
  "fit.wiener_background": (value) => value("fit.filter") === "wiener",
  "fit.wiener_cutoff": (value) => value("fit.filter") === "wiener",
  "fit.tv_fidelity": (value) => value("fit.filter") === "tv-l1",
  "fit.tv_iterations": (value) => value("fit.filter") === "tv-l1",
  "fit.sigma_factor": (value) => value("fit.shape") === "free",
};

/** Choices in words; a choice that is not here stands for itself. */
const CHOICES = {
  "fit.estimator": { lsq: "Least squares", poisson: "Poisson likelihood" },
  "fit.shape": { fixed: "Fixed, as in the sum", free: "Free in every frame" },
  "fit.filter": { gaussian: "Gaussian blur", wiener: "Wiener", "tv-l1": "TV-L1", none: "None" },
  "fit.intensity_scale": { paper: "Box (0.9111)", ellipse: "Ellipse (0.8647)" },
  "drift.method": { auto: "Measure", csv: "From a CSV file", none: "None" },
  "columns.method": { auto: "Automatic", lattice: "Lattices", csv: "From a CSV file", maxima: "Maxima", blobs: "Blobs", template: "Template" },
  "columns.contrast": { auto: "Bright or dark, as the image says", bright: "Bright", dark: "Dark" },
};

/** Names in words, where the declared name with spaces would not do. */
const TITLES = {
  "metadata.pixel_size_pm": "Pixel size", "metadata.frame_time_s": "Frame time", "metadata.dose": "Dose of a frame", "metadata.gain": "Gain", "metadata.offset": "Offset",
  "fit.window_px": "Fit window", "fit.blur_sigma_px": "Blur", "fit.shape": "Shape of a column", "drift.method": "Drift", "columns.method": "Find columns", "columns.contrast": "Columns are",
  "columns.csv": "Table of columns", "drift.csv": "Table of drift", "convert.shard_mb": "Shard",
  "source.roi": "Field", "source.bin": "Binning",
};

const UNITS = { "e/A^2": "e/Å²", counts: "counts", px: "px" };

export const unitText = (unit) => UNITS[unit] ?? unit;

/** One setting: its control, its sentence, what is wrong with it, and a way back to the default. */
class Setting {
  /**
   * @param {Declared} row
   * @param {(setting: Setting) => void} onChange
   */
  constructor(row, onChange) {
    this.row = row;
    this.key = `${row.group}.${row.name}`;
    this.onChange = onChange;
    this.id = `setting-${row.group}-${row.name}`;
    this.changed = false;
    /** @type {HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement} */
    this.control = this.makeControl();
    this.problem = h("div", { class: "problem", id: `${this.id}-problem`, hidden: true });
    this.undo = h("button", { type: "button", class: "link undo", hidden: true, onclick: () => { this.reset(); onChange(this); }, "aria-label": `Reset ${this.title}` }, "Reset");
    const hint = h("div", { class: "hint", id: `${this.id}-hint` }, row.description);
    const unit = row.unit && row.type !== "boolean" ? h("span", { class: "unit" }, unitText(row.unit)) : null;
    this.control.setAttribute("aria-describedby", `${hint.id} ${this.problem.id}`);
    const wide = row.items === "object";
    this.element = h("div", { class: `field setting${wide ? " wide" : ""}`, dataset: { setting: this.key } },
      h("div", { class: "label" }, row.type === "boolean" ? h("label", { class: "check" }, this.control, this.title) : h("label", { for: this.id }, this.title), this.undo),
      row.type === "boolean" ? null : h("div", { class: "with-unit" }, this.control, unit), this.problem, hint);
    this.reset();
  }

  get title() {
    const text = this.row.name.replace(/_(px|pm|s|mb)$/, "").replaceAll("_", " ");
    return TITLES[this.key] ?? text[0].toUpperCase() + text.slice(1);
  }

  makeControl() {
    const { row, id } = this;
    const changed = () => { this.check(); this.onChange(this); };
    if (row.choices.length) {
      const words = CHOICES[this.key] ?? {};
      return h("select", { class: "input", id, onchange: changed }, ...row.choices.map((choice) => h("option", { value: choice }, words[choice] ?? choice)));
    }
    if (row.type === "boolean") return h("input", { type: "checkbox", id, onchange: changed });
    if (row.items === "object") return h("textarea", { class: "input", id, oninput: changed, spellcheck: "false", placeholder: '[{"origin": [10, 10], "a": [90, 12], "a_count": 9, "b": [8, 70], "b_count": 7}]' });
    const numeric = row.type === "integer" || row.type === "number";
    return h("input", { class: "input", id, oninput: changed, inputmode: numeric && !row.words.length ? "decimal" : null, autocomplete: "off", spellcheck: "false", placeholder: this.placeholder() });
  }

  placeholder() {
    const { row } = this;
    if (row.optional) return row.type === "string" ? "" : "automatic";
    return String(row.default);
  }

  /**
   * Say what stands where the user leaves it empty.
   * @param {string} text
   */
  setPlaceholder(text) { if ("placeholder" in this.control) this.control.placeholder = text; }

  reset() { this.set(this.row.default); }

  set(value) {
    const { control, row } = this;
    if ("checked" in control && row.type === "boolean") control.checked = value;
    else if (row.choices.length) control.value = value;
    else if (row.items === "object") control.value = value?.length ? JSON.stringify(value) : "";
    else if (Array.isArray(value)) control.value = value.join(", ");
    else control.value = value === null || value === row.default ? "" : String(value);
    this.check();
  }

  /** The value; undefined where it is the default. Throws an Error with what is wrong. */
  read() {
    const { control, row } = this;
    let value = /** @type {any} */ (control.value);
    if ("checked" in control && row.type === "boolean") value = control.checked;
    else if (!row.choices.length) {
      const text = control.value.trim();
      if (!text) return undefined;
      value = row.words.includes(text) ? text : row.items === "object" ? tables(text) : row.type === "array" ? text.split(",").map((part) => number(part, true)) : row.type === "string" ? text : number(text, row.type === "integer");
      if (row.low !== null && value < row.low) throw new Error(`At least ${row.low} ${unitText(row.unit)}`);
      if (row.high !== null && value > row.high) throw new Error(`At most ${row.high} ${unitText(row.unit)}`);
    }
    return JSON.stringify(value) === JSON.stringify(row.default) ? undefined : value;
  }

  /** The value with which the job would run. */
  effective() {
    try { return this.read() ?? this.row.default; } catch { return this.row.default; }
  }

  check() {
    let changed = false, message = "";
    try { changed = this.read() !== undefined; } catch (error) { [changed, message] = [true, error.message]; }
    this.changed = changed;
    this.element?.classList.toggle("changed", changed);
    if (this.undo) this.undo.hidden = !changed;
    if (this.problem) this.showProblem(message);
    return !message;
  }

  showProblem(message) {
    setText(this.problem, message);
    this.problem.hidden = !message;
    setAttribute(this.control, "aria-invalid", message ? "true" : null);
  }
}

/**
 * @param {string} text
 * @param {boolean} whole whether it must be
 */
function number(text, whole) {
  const value = Number(text.trim().replace(/^(-?\d+),(\d+)$/, "$1.$2"));
  if (!Number.isFinite(value) || text.trim() === "") throw new Error(`“${text.trim()}” is not a number`);
  if (whole && !Number.isInteger(value)) throw new Error(`“${text.trim()}” is not a whole number`);
  return value;
}

function tables(text) {
  try {
    const found = JSON.parse(text);
    if (Array.isArray(found)) return found;
  } catch { /* said below */ }
  throw new Error("This is not a JSON list, such as the one shown when the field is empty");
}

export class SettingsForm {
  /**
   * @param {Declared[]} rows as GET /settings tells them
   * @param {{ metadata: HTMLElement, important: HTMLElement, groups: HTMLElement }} places
   * @param {string[]} important keys of those that are seen first, such as "fit.estimator"
   * @param {() => void} onChange after every change
   */
  constructor(rows, places, important, onChange) {
    /** @type {Map<string, Setting>} */
    this.settings = new Map();
    this.onChange = onChange;
    for (const row of rows) {
      const setting = new Setting(row, () => { this.arrange(); onChange(); });
      this.settings.set(setting.key, setting);
    }
    const of = (/** @type {Declared} */ row) => this.settings.get(`${row.group}.${row.name}`) ?? [];
    places.metadata.append(...rows.filter((row) => row.group === "metadata").flatMap(of).map((one) => one.element));
    places.important.append(...important.flatMap((key) => this.settings.get(key) ?? []).map((one) => one.element));
    this.groups = [...new Set(rows.map((row) => row.group))].filter((group) => group !== "metadata").map((group) => {
      const own = rows.filter((row) => row.group === group && !important.includes(`${group}.${row.name}`)).flatMap(of);
      const number = h("span", { class: "count" });
      const title = rows.find((row) => row.group === group)?.title ?? group;
      const details = h("details", { class: "group", id: `group-${group}` }, h("summary", {}, `More: ${title.toLowerCase()} `, h("span", { class: "muted small" }, `${own.length}`), number), h("div", { class: "grid-3" }, ...own.map((one) => one.element)));
      return { group, own, number, details };
    });
    places.groups.append(...this.groups.map(({ details }) => details));
    this.arrange();
  }

  arrange() {
    const value = (key) => this.settings.get(key)?.effective();
    for (const [key, setting] of this.settings) setting.element.hidden = !(setting.changed || (ONLY_WITH[key]?.(value) ?? true));
    for (const { own, number } of this.groups) {
      const changed = own.filter((one) => one.changed).length;
      setText(number, changed ? `${changed} changed` : "");
    }
  }

  /** How many are not at their defaults. */
  get changed() { return [...this.settings.values()].filter((one) => one.changed).length; }

  /** The changed settings by group and name; null where one of them is wrong, as its field then says. */
  values() {
    const found = {};
    let fine = true;
    for (const setting of this.settings.values()) {
      if (!setting.check()) { fine = false; continue; }
      const value = setting.read();
      if (value !== undefined) (found[setting.row.group] ??= {})[setting.row.name] = value;
    }
    return fine ? found : null;
  }

  /** Set all from nested values; what is not among them goes to its default. */
  set(values) {
    for (const setting of this.settings.values()) setting.set(values[setting.row.group]?.[setting.row.name] ?? setting.row.default);
    this.arrange();
  }

  get(key) { return this.settings.get(key); }

  /** Put what the service refused beside its field, if it names one. Tells whether it did. */
  showRefused(error) {
    const found = /setting (\w+) \((\w+)Settings\)/.exec(error.where ?? "");
    const wanted = found && { source: "source", metadata: "metadata", convert: "convert", drift: "drift", column: "columns", fit: "fit" }[found[2].toLowerCase()];
    const setting = wanted && this.settings.get(`${wanted}.${found[1]}`);
    if (!setting) return false;
    setting.element.hidden = false;
    setting.element.closest("details")?.setAttribute("open", "");
    setting.showProblem([error.what, error.expected && `expected ${error.expected}`, error.remedy].filter(Boolean).join("; "));
    return true;
  }
}
