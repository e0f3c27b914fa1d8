// A new job: choose a movie, look at it, set what needs setting, see what it takes, submit.

import { get, post, toast } from "./api.js";
import { at, h, setText } from "./dom.js";
import { FolderBrowser } from "./folder_browser.js";
import { bytes, count, duration, left, nameOf, significant, several } from "./format.js";
import { MoviePreview } from "./movie_preview.js";
import { SettingsForm } from "./settings_form.js";

/**
 * @import { Job, Movie } from "./api.js"
 * @typedef {Record<string, Record<string, any>>} Values of settings, by group and name
 */

const IMPORTANT = ["fit.estimator", "fit.shape", "fit.window_px", "drift.method", "columns.method", "columns.contrast"];
const WAIT_MS = 350; // after the last change, before the plan is made anew

const preview = new MoviePreview(at("preview"));
const browser = new FolderBrowser(at("browser"), { onMovie: (path) => choose(path), onFolder: (path) => go({ folder: path }) });
/** @type {SettingsForm} */
let form; // once the settings are declared
let source = "", about = /** @type {Movie | null} */ (null), planning = 0;

function go(parameters) {
  const query = new URLSearchParams(Object.entries(parameters).filter(([, value]) => value));
  const address = query.size ? `?${query}` : location.pathname;
  if (address !== (location.search || location.pathname)) history.pushState(null, "", address);
}

/** Show what the address says: a movie, or a folder to choose one in. */
async function arrive() {
  const query = new URLSearchParams(location.search);
  const template = query.get("from");
  if (template) {
    try {
      /** @type {Job} */
      const job = await get(`/jobs/${template}`);
      form.set(job.settings);
      at("label", HTMLInputElement).value = job.label;
      at("curate", HTMLInputElement).checked = job.curate;
      history.replaceState(null, "", `?${new URLSearchParams({ source: job.source })}`);
      toast(`The settings are those of “${nameOf(job)}”.`);
      await choose(job.source, false);
      return;
    } catch (error) { toast(error); }
  }
  const path = query.get("source");
  if (path) await choose(path, false);
  else {
    [source, about] = ["", null]; // a plan that waits is not asked for
    show(false);
    await browser.open(query.get("folder") ?? "", false);
  }
}

function show(chosen) {
  at("choose").hidden = chosen;
  at("chosen").hidden = !chosen;
}

async function choose(path, note = true) {
  if (note) go({ source: path });
  if (note && path !== source) for (const name of ["frames", "roi", "bin"]) form.get(`source.${name}`)?.reset(); // a part of another movie
  source = path;
  about = null;
  show(true);
  setText(at("source-name"), path.split("/").pop());
  at("source-name").title = path;
  setText(at("source-facts"), "Reading …");
  await readMovie();
}

/** Read what the movie says about itself, as the settings for raw files declare it. */
async function readMovie() {
  const path = source, reading = readingOf(form.values() ?? {});
  at("source-problem").replaceChildren();
  try {
    /** @type {Movie} */
    const found = await get("/files/about", { path, ...reading });
    if (source !== path) return;
    about = found;
    at("preview").hidden = false;
    const [frames, height, width] = found.shape;
    setText(at("source-facts"), [path.split("/").slice(0, -1).join("/"), several(frames, "frame"), `${count(width)} × ${count(height)} px`, found.dtype, bytes(found.bytes), found.format + (found.files > 1 ? `, ${several(found.files, "file")}` : "")].filter(Boolean).join(" · "));
    preview.show(found, { ...reading, raw_shape: reading.raw_shape?.join() });
    showMetadata(found);
  } catch (error) {
    if (source !== path) return;
    if (about && form.showRefused(error)) { plan(); return; } // such as a part that is half typed
    at("preview").hidden = true;
    setText(at("source-facts"), "");
    at("source-problem").replaceChildren(h("div", { class: "notice bad", role: "alert" }, h("p", {}, h("b", {}, error.what)), error.expected && h("p", { class: "small" }, `Expected ${error.expected}${error.got ? `; got ${error.got}` : ""}`), h("p", {}, error.remedy)));
    if (/raw[-_]shape/i.test(error.text ?? error.message)) at("group-source", HTMLDetailsElement).open = true;
  }
  plan();
}

/**
 * The settings that say how a raw file is read, and which part of any movie.
 * @param {Values} values
 */
function readingOf(values) {
  const { raw_shape, raw_dtype, raw_offset, frames, roi, bin } = values.source ?? {};
  return { raw_shape, raw_dtype, raw_offset, frames, roi, bin };
}

/** @param {Movie} movie */
function showMetadata({ file_pixel_size_pm: pixel_size_pm, file_frame_time_s: frame_time_s, dose, gain, warnings }) {
  const known = (/** @type {number | null} */ value, digits = 4) => (value === null ? "unknown" : significant(value, digits));
  for (const [name, value] of Object.entries({ pixel_size_pm, frame_time_s, dose, gain })) form.get(`metadata.${name}`)?.setPlaceholder(known(value));
  const missing = [[pixel_size_pm, "pixel size", "results stay in px"], [frame_time_s, "frame time", "time is in frames"]]
    .filter(([value, , ]) => value === null).map(([, what, then]) => `no ${what} (${then})`);
  const notes = [...warnings];
  if (missing.length) notes.unshift(`The file has ${missing.join(" and ")}, unless you give it here.`);
  at("metadata-note").replaceChildren(...notes.map((note) => h("div", { class: "notice warn" }, note)));
  at("metadata-note").hidden = notes.length === 0;
}

let waiting = 0, read = "";
function onChange() {
  at("reset").hidden = form.changed === 0;
  clearTimeout(waiting);
  waiting = setTimeout(() => {
    const values = form.values();
    const reading = JSON.stringify(values && readingOf(values));
    const given = values?.metadata?.pixel_size_pm; // of a pixel on disk
    preview.setPixelSize(given ? given * (values?.source?.bin ?? 1) : about?.pixel_size_pm ?? null);
    if (values && reading !== read) { read = reading; if (source) readMovie(); } else plan();
  }, WAIT_MS);
}

/** Ask what the job will take, and show it. */
async function plan() {
  const mine = ++planning, values = form.values();
  if (!values || !about) at("submit", HTMLButtonElement).disabled = true; // otherwise it stays as it is: a click shall not be lost
  if (!values) { showPlanNote("warn", "A setting is wrong; its field says what."); return; }
  if (!about) { at("plan-body").replaceChildren(h("span", { class: "muted" }, "The plan follows when the movie can be read.")); return; }
  at("plan").setAttribute("aria-busy", "true");
  try {
    const found = await post("/plan", { source, settings: values });
    if (mine !== planning) return;
    showPlan(found);
    at("submit", HTMLButtonElement).disabled = false;
  } catch (error) {
    if (mine !== planning) return;
    at("submit", HTMLButtonElement).disabled = true;
    const beside = form.showRefused(error);
    showPlanNote("bad", error.what, beside ? "See the field that is marked." : [error.where, error.expected && `expected ${error.expected}`, error.got && `got ${error.got}`].filter(Boolean).join("; "), beside ? "" : error.remedy);
  }
  if (mine === planning) at("plan").removeAttribute("aria-busy");
}

function showPlanNote(kind, what, detail = "", remedy = "") {
  at("plan-body").replaceChildren(h("div", { class: `notice ${kind}` }, h("p", {}, h("b", {}, what)), detail && h("p", { class: "small" }, detail), remedy && h("p", {}, remedy)));
}

function showPlan(found) {
  const figure = (name, value, note, kind = "") => h("div", {}, h("dt", {}, name), h("dd", { class: kind }, value, h("small", {}, note)));
  const tooBig = found.bytes_written > found.disk_free, tooMuch = found.memory_limit && found.peak_memory > found.memory_limit;
  const figures = h("dl", { class: "figures" },
    figure("Time, about", found.seconds < 5 ? duration(found.seconds) : left(found.seconds), several(found.frames, "frame")),
    figure("Reads", bytes(found.bytes_read), several(found.shards, "shard")),
    figure("Writes at most", bytes(found.bytes_written), `of ${bytes(found.disk_free)} free`, tooBig ? "bad" : ""),
    figure("Memory a task", bytes(found.peak_memory), found.memory_limit ? `of ${bytes(found.memory_limit)}` : "no limit known", tooMuch ? "bad" : ""));
  at("plan-body").replaceChildren(...(found.fits ? [] : [h("div", { class: "notice bad", role: "alert" }, h("p", {}, h("b", {}, "This does not fit: "), found.problem))]), figures);
  setText(at("submit"), found.fits ? "Submit" : "Submit all the same");
}

async function submit(event) {
  event.preventDefault();
  const values = form.values();
  if (!values || !about) return;
  clearTimeout(waiting);
  planning += 1; // a plan that is on its way is not waited for: the service checks the job once more
  at("submit", HTMLButtonElement).disabled = true;
  try {
    const job = await post("/jobs", { source, settings: values, label: at("label", HTMLInputElement).value.trim(), curate: at("curate", HTMLInputElement).checked });
    location.assign(`/jobs/${job.id}`);
  } catch (error) {
    if (!form.showRefused(error)) toast(error);
    at("submit", HTMLButtonElement).disabled = false;
  }
}

async function start() {
  try {
    const { settings } = await get("/settings");
    form = new SettingsForm(settings, { metadata: at("metadata"), important: at("important"), groups: at("groups") }, IMPORTANT, onChange);
    read = JSON.stringify(readingOf({}));
  } catch (error) { toast(error); return; }
  at("form").addEventListener("submit", submit);
  at("reset").addEventListener("click", () => { form.set({}); onChange(); });
  at("other").addEventListener("click", () => { const folder = source.split("/").slice(0, -1).join("/"); history.pushState(null, "", folder ? `?${new URLSearchParams({ folder })}` : "/new"); arrive(); });
  addEventListener("popstate", arrive);
  await arrive();
}

start();
