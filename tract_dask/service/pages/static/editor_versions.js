// The versions of a job's columns: the list, loading, saving, and going on; and what is not saved, kept over a reload.

import { get, post, subscribe, toast } from "./api.js";
import { ask, h, setText } from "./dom.js";
import { count, fullTime, hasEnded, moment, several } from "./format.js";

const DRAFT_MS = 400;

/**
 * @import { Editor } from "./editor.js"
 * @import { Draft } from "./editor_model.js"
 * @typedef {{ version: number, author: string, time: string, note: string, count: number }} Version
 * @typedef {object} Known what the API says of the versions
 * @property {string} state of the job
 * @property {Version[]} versions
 * @property {number | null} chosen
 * @property {number} next_column_id
 * @property {boolean} may_save
 * @property {boolean} may_continue
 * @typedef {object} Places
 * @property {HTMLElement} list
 * @property {HTMLInputElement} note
 * @property {HTMLElement} unsaved
 * @property {HTMLButtonElement} save
 * @property {HTMLButtonElement} goOn
 * @property {boolean} alone whether the editor was opened by itself
 * @property {boolean} framed whether it is a part of another page
 */

export class Versions {
  /**
   * @param {Editor} editor
   * @param {Places} places
   */
  constructor(editor, { list, note, unsaved, save, goOn, alone, framed }) {
    this.editor = editor;
    this.list = list;
    this.note = note;
    this.unsaved = unsaved;
    this.save = save;
    this.goOn = goOn;
    this.alone = alone;
    this.busy = this.left = false;
    this.timer = 0;
    /** @type {Known | null} */
    this.known = null;
    this.key = `tract_dask.columns.${alone ? location.pathname : editor.job}`;
    save.onclick = () => this.keep();
    goOn.onclick = () => this.continue();
    goOn.hidden = framed;
    save.classList.toggle("primary", framed);
    addEventListener("beforeunload", (event) => {
      if (editor.model.dirty && !this.left) event.preventDefault();
    });
    addEventListener("pagehide", () => this.keepDraft());
    editor.model.addEventListener("change", () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.keepDraft(), DRAFT_MS);
      this.tell();
    });
    if (!alone) subscribe(`/jobs/${editor.job}/events`, { job: ({ state }) => state !== this.known?.state && this.refresh() });
    else new EventSource("open"); // as long as this page is open, so is the editor
  }

  /** Load what there is: the draft where there is one, else the newest version. */
  async open() {
    const { versions } = await this.refresh();
    const draft = this.draft();
    const newest = versions[versions.length - 1].version;
    const wanted = new URLSearchParams(location.search).get("version");
    const asked = wanted === null ? newest : Number(wanted);
    const base = draft?.version ?? asked;
    await this.load(versions.some(({ version }) => version === base) ? base : newest, false);
    if (draft && this.editor.model.restore(draft)) {
      toast("Changes that were not saved are back; undo takes them away.", "good");
    }
  }

  async refresh() {
    /** @type {Known} */
    const known = await get(`/jobs/${this.editor.job}/columns`);
    this.known = known;
    this.tell();
    return known;
  }

  /**
   * Show a version; with care, ask where changes would be lost.
   * @param {number} version
   */
  async load(version, careful = true) {
    const { model } = this.editor;
    if (careful && model.dirty) {
      const sure = await ask({
        title: "Leave the changes behind?", text: `What you changed since version ${model.version} is not saved.`,
        action: `Load version ${version}`, danger: true,
      });
      if (!sure) return;
    }
    const table = await get(`/jobs/${this.editor.job}/columns/${version}`);
    const columns = table.columns.map(({ column_id: id, x, y, kind, flags }) => ({ id, x, y, kind, flags }));
    model.load({ version, columns, spacing: table.spacing_px, nextId: this.known?.next_column_id ?? 1 });
    if (careful) this.forgetDraft();
    this.tell();
    if (version) this.editor.refined.flags();
  }

  /** Save the columns as a version; null where that failed. */
  async keep() {
    const { editor } = this;
    const { model } = editor;
    if (this.busy) return null;
    this.busy = true;
    this.tell();
    try {
      const columns = model.rows();
      const mark = model.mark();
      const answer = await post(`/jobs/${editor.job}/columns`, { columns, note: this.note.value.trim(), base: model.version });
      model.saved(answer.version, mark);
      this.note.value = "";
      if (!model.dirty) this.forgetDraft();
      await this.refresh();
      const others = answer.newer.length ? ` Meanwhile version ${answer.newer.join(" and ")} was saved elsewhere; both are kept.` : "";
      toast(`Version ${answer.version} with ${several(answer.count, "column")} is saved.${others}`, "good");
      return answer.version;
    } catch (error) {
      toast(error);
      return null;
    } finally {
      this.busy = false;
      this.tell();
    }
  }

  /** Let the job go on with these columns. */
  async continue() {
    const { editor, known } = this;
    if (!this.alone && known && hasEnded(known.state)) {
      const sure = await ask({
        title: "Fit every frame again?", text: "The tracks that the job has are replaced by those of these columns.", action: "Fit again",
      });
      if (!sure) return;
    }
    const version = editor.model.dirty ? await this.keep() : editor.model.version;
    if (version === null) return;
    try {
      await post(`/jobs/${editor.job}/continue`, { version });
    } catch (error) {
      toast(error);
      this.refresh().catch(() => {});
      return;
    }
    this.left = true;
    if (this.alone) editor.end();
    else location.assign(`/jobs/${editor.job}`);
  }

  tell() {
    const { editor, known, busy } = this;
    const { model } = editor;
    if (!known || model.version === null) return;
    const { dirty, version, size } = model;
    setText(this.unsaved, busy ? "Saving …" : dirty ? "Not saved" : version === 0 ? "" : `Saved as version ${version}`);
    this.unsaved.classList.toggle("warn", dirty);
    this.save.disabled = busy || !dirty || !size || !known.may_save;
    this.save.title = known.may_save ? "Keep these columns as a version (Ctrl+S)" : "The job belongs to someone else";
    const again = hasEnded(known.state) && !this.alone;
    const verb = this.alone ? "close" : again ? "fit again" : "go on";
    const which = version === 0 ? "the automatic columns" : `version ${version}`;
    setText(this.goOn, dirty ? `Save and ${verb}` : this.alone ? "Close" : `${again ? "Fit again" : "Go on"} with ${which}`);
    this.goOn.disabled = busy || !size || !known.may_continue || (dirty && !known.may_save);
    this.goOn.title = known.may_continue ? "" : "Possible where the job waits for columns, or has ended";
    this.list.replaceChildren(...[...known.versions].reverse().map((one) => this.row(one)));
  }

  /** @param {Version} one */
  row(one) {
    const { model } = this.editor;
    const current = one.version === model.version;
    const marks = [current && (model.dirty ? "changed here" : "shown"), one.version === this.known?.chosen && "chosen"].filter(Boolean);
    return h("li", { class: current ? "current" : null },
      h("button", { type: "button", onclick: () => this.load(one.version).catch(toast), disabled: current && !model.dirty, title: `Load version ${one.version}${one.note ? `: ${one.note}` : ""}` },
        h("span", { class: "version-number" }, String(one.version)),
        h("span", { class: "version-about" },
          h("span", {}, one.version ? one.author : "Automatic", " · ", h("time", { datetime: one.time, title: fullTime(one.time) }, moment(one.time)), " · ", count(one.count)),
          one.note && h("span", { class: "muted" }, one.note),
          marks.length ? h("span", { class: "version-mark" }, marks.join(", ")) : null)));
  }

  /** @returns {Draft | null} */
  draft() {
    try {
      return JSON.parse(sessionStorage.getItem(this.key) ?? "null");
    } catch {
      return null;
    }
  }

  keepDraft() {
    const { model } = this.editor;
    clearTimeout(this.timer);
    try {
      if (model.dirty) sessionStorage.setItem(this.key, JSON.stringify(model.draft()));
      else sessionStorage.removeItem(this.key);
    } catch { /* more than the browser keeps: leaving warns all the same */ }
  }

  forgetDraft() {
    clearTimeout(this.timer);
    sessionStorage.removeItem(this.key);
  }
}
