// A job while it runs and after: kept up to date by its events, and by what its finished shards say.

import { get, post, subscribe, toast } from "./api.js";
import { at, find, h, setAttribute, setText } from "./dom.js";
import { between, count, duration, fullTime, hasEnded, isDone, left, moment, nameOf, percent, rate, several, STAGES, STATES } from "./format.js";
import { actionButton, actionsOf, isCancelling, mayChange } from "./job_actions.js";
import { FrameCharts, Throughput } from "./job_charts.js";
import { Log } from "./job_log.js";
import { JobPicture } from "./job_picture.js";
import { Stages } from "./job_stages.js";
import { Workers } from "./job_workers.js";

/** @import { Job, Progress } from "./api.js" */

const RESULTS_MS = 3000; // between two looks at the results, at least
const POINTS = 600;

const id = document.body.dataset.job ?? "";
const stages = new Stages(at("stages"), at("stages-total"));
const throughput = new Throughput(at("speed"));
const charts = new FrameCharts({ accepted: at("accepted"), drift: at("drift"), note: at("accepted-note") });
const workers = new Workers(at("workers"));
const log = new Log(at("log"));
const picture = new JobPicture({ element: at("picture"), scale: at("scale"), pointed: at("pointed"), title: at("picture-title"), select: at("colour-by", HTMLSelectElement) }, id);
/** @type {Job} */
let job; // once it is read

const stageState = (/** @type {string} */ name) => job.progress.stages?.[name]?.state ?? "pending";
const isPast = (name) => ["done", "reused"].includes(stageState(name));
/** Whether there is a summed image: a stage is done a moment before its store is. */
const hasSum = () => isPast("sum") && (stageState("columns") !== "pending" || job.state !== "running");

function show() {
  setAttribute(at("badge"), "data-state", job.state);
  setText(at("badge"), isCancelling(job) ? "Cancelling" : STATES[job.state]);
  setText(at("name"), nameOf(job));
  at("rename").hidden = !mayChange(job);
  showActions();
  showCall();
  showAbout();
  showProgress();
  at("workers-panel").hidden = job.state !== "running" && job.state !== "queued";
}

function showActions() {
  const links = [];
  const columns = isPast("columns");
  if (columns && job.state !== "waiting_for_columns") links.push(h("a", { class: "button", href: `/jobs/${id}/columns` }, "Columns"));
  if (isDone(job.state)) links.push(downloads(), h("a", { class: "button primary", href: `/jobs/${id}/results` }, "Results"));
  else if (stageState("fit") !== "pending") links.push(h("a", { class: "button", href: `/jobs/${id}/results` }, "Results so far"));
  links.push(h("a", { class: "button", href: `/new?from=${id}` }, "New job like this"));
  const wanted = [job.state, job.reason === "cancelling", columns, links.length, nameOf(job)].join();
  if (at("actions").dataset.drawn === wanted) return;
  at("actions").dataset.drawn = wanted;
  const retry = job.state === "failed" || job.state === "cancelled"; // then it stands in the call above
  const buttons = actionsOf(job).filter((action) => !(retry && action === "retry")).map((action) => actionButton(job, action, (done) => done === "delete" && location.assign("/"), ""));
  at("actions").replaceChildren(...links, ...buttons);
}

function downloads() {
  const link = (format, text) => h("a", { href: `/api/v1/jobs/${id}/results/download?format=${format}`, download: "" }, text);
  return h("details", { class: "menu" }, h("summary", { class: "button" }, "Download"),
    h("div", { class: "menu-list" }, link("zarr", "Dataset (Zarr, zipped)"), link("nc", "Dataset (NetCDF)"), link("csv", "Table (CSV)"), h("a", { href: `/api/v1/jobs/${id}/report`, target: "_blank", rel: "noopener" }, "Report ↗")));
}

function showCall() {
  const wanted = [job.state, job.reason].join();
  if (at("call").dataset.drawn === wanted) return;
  at("call").dataset.drawn = wanted;
  const [first = "", ...rest] = job.reason.replace(/\.$/, "").split(/\. (?=[A-Z])/);
  const retry = () => actionsOf(job).includes("retry") && actionButton(job, "retry", null, "primary large");
  const notice = (kind, title, texts, ...buttons) => h("div", { class: `notice ${kind}`, role: kind === "bad" ? "alert" : null }, h("div", {}, h("h2", {}, title), ...texts.filter(Boolean).map((text) => h("p", {}, text))), ...buttons.filter(Boolean));
  const calls = {
    waiting_for_columns: () => notice("accent", "The columns are found and wait for you", ["Look at them on the summed image, delete, move or add some, and let the job go on."], h("a", { class: "button primary large", href: `/jobs/${id}/columns` }, "Check the columns")),
    failed: () => notice("bad", "The job failed", [first, ...rest], retry()),
    cancelled: () => notice("", "The job was cancelled", ["What was done is kept; Retry goes on from there."], retry()),
    done_with_failed_frames: () => notice("warn", "Some frames could not be fitted", [job.reason || "They have no results; the log names them. All other frames are done."]),
    queued: () => notice("", "In the queue", [job.attempts ? job.reason : "It starts as soon as the jobs before it leave room."]),
  };
  at("call").replaceChildren(...(calls[job.state] ? [calls[job.state]()] : []));
}

function showProgress() {
  const { progress, state, outcome } = job;
  const fraction = isDone(state) ? 1 : progress.fraction ?? 0;
  const title = STAGES[progress.stage || job.stage];
  const words = { queued: "Waiting to start", waiting_for_columns: "Stopped after the columns were found", failed: title ? `Stopped in the stage ${title}` : "Stopped before the first stage", cancelled: title ? `Stopped in the stage ${title}` : "Stopped before the first stage", done: "All stages are done", done_with_failed_frames: "All stages are done" };
  const frames = progress.frames ? ` · ${count(progress.done_frames)} of ${several(progress.frames, "frame")}${progress.passes > 1 ? ` in ${progress.passes} passes` : ""}` : "";
  setText(at("stage"), words[state] ?? (title ? `${title}${frames}` : "Starting: the cluster gets ready"));
  setText(at("share"), percent(fraction, 0));
  const kind = { done: "good", done_with_failed_frames: "warn", failed: "bad", cancelled: "still", waiting_for_columns: "warn" }[state] ?? "";
  setAttribute(at("bar"), "class", `bar large ${kind}`);
  setAttribute(at("bar"), "aria-valuenow", Math.round(fraction * 100));
  find(":scope > *", undefined, at("bar")).style.setProperty("--done", String(fraction));
  const running = state === "running";
  /** @type {[name: string, value: string][]} */
  const figures = isDone(state)
    ? [["Frames", count(outcome.frames)], ["Columns", count(outcome.columns)], ["Fits", count(outcome.fits)], ["Accepted", outcome.fits ? percent((outcome.accepted ?? NaN) / outcome.fits) : "–"], ["Took", job.started && job.ended ? duration(between(job.started, job.ended)) : "–"]]
    : !running ? [] : [["Time left", progress.seconds_left !== undefined && Number.isFinite(progress.seconds_left) ? left(progress.seconds_left) : "–"], ["Frames/s", progress.frames_per_s ? rate(progress.frames_per_s) : "–"], ["Fits/s", progress.fits_per_s ? rate(progress.fits_per_s) : "–"], ["Running for", job.started ? duration(Math.round(between(job.started))) : "–"]];
  showFigures(figures);
  stages.show(job);
  document.title = `${running ? `${percent(fraction, 0)} · ` : ""}${nameOf(job)} · tract_dask`;
}

/** @param {[name: string, value: string][]} figures */
function showFigures(figures) {
  const names = figures.map(([name]) => name).join(), place = at("figures");
  place.hidden = figures.length === 0;
  if (place.dataset.names !== names) {
    place.dataset.names = names;
    place.replaceChildren(...figures.map(([name]) => h("div", {}, h("dt", {}, name), h("dd", {}))));
  }
  figures.forEach(([, value], index) => setText(/** @type {Node} */ (place.children[index].lastChild), value));
}

function showAbout() {
  const settings = Object.entries(job.settings).flatMap(([group, values]) => Object.entries(values).filter(([name, value]) => isChanged(group, name, value)).map(([name, value]) => `${name} = ${typeof value === "object" ? JSON.stringify(value) : value}`));
  const rows = [["Owner", job.owner], ["Submitted", fullTime(job.created)], ["Started", job.started ? moment(job.started) : "–"], ["Ended", job.ended ? moment(job.ended) : "–"]];
  if (job.attempts > 1) rows.push(["Begun", several(job.attempts, "time")]);
  rows.push(["Results in", job.output], ["Columns", job.columns_version === null ? (job.curate ? "stops for you to check them" : "found automatically") : `version ${job.columns_version}`], ["Settings", settings.length ? settings.join(", ") : "all at their defaults"]);
  at("about").replaceChildren(...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
}

let defaults = /** @type {Map<string, any> | null} */ (null);
function isChanged(group, name, value) {
  const known = defaults?.get(`${group}.${name}`);
  return defaults !== null && JSON.stringify(known) !== JSON.stringify(value);
}

/** Draw what the stages have made so far. */
let drawn = "";
function showMade() {
  const wanted = [hasSum(), ...["sum", "columns"].map(stageState)].join() + job.columns_version + job.attempts;
  if (wanted !== drawn) {
    const again = drawn && !drawn.endsWith(`${job.columns_version}${job.attempts}`);
    drawn = wanted;
    if (again) picture.forget();
    if (hasSum()) picture.showSum(); else picture.showFrame();
    if (isPast("columns")) picture.showColumns(job.columns_version);
  }
  if (stageState("fit") !== "pending") lookAtResults();
}

let looked = 0, looking = 0, fitted = "";
/** Read what the finished shards say: soon, not too often, and only while somebody looks. */
function lookAtResults() {
  const now = [job.progress.stages?.fit?.done_frames, stageState("fit"), job.state].join();
  if (looking || now === fitted) return;
  looking = setTimeout(async () => {
    if (!document.hidden) {
      looked = performance.now();
      try { // one after the other: the service does such work in few processes
        charts.show(await get(`/jobs/${id}/results/frames`, { points: POINTS }));
        picture.showValues(await get(`/jobs/${id}/results/columns`));
        fitted = now;
      } catch (error) { if (![404, 409, 503].includes(error.status)) fitted = now; } // nothing is fitted yet, or it is being replaced
    }
    looking = 0;
    if (!document.hidden && job.state === "running") lookAtResults();
  }, Math.max(0, RESULTS_MS - (performance.now() - looked)));
}

/** @param {Job} changed */
function onJob(changed) {
  if (changed.deleted) {
    at("call").replaceChildren(h("div", { class: "notice" }, h("div", {}, h("h2", {}, "This job was deleted"), h("a", { href: "/" }, "To the list of jobs"))));
    at("actions").replaceChildren();
    return;
  }
  if (changed.state !== job.state) log.addTransition({ time: changed.ended ?? new Date().toISOString(), state: changed.state, reason: changed.reason });
  Object.assign(job, changed);
  show();
  throughput.show(job);
  showMade();
}

/** @param {Progress} progress */
function onProgress(progress) {
  job.progress = progress;
  throughput.add(progress);
  throughput.show(job);
  showProgress();
  showActions();
  showMade();
}

function onWorkers({ workers: seen, dashboard }) {
  workers.show(seen);
  at("dashboard").hidden = !dashboard;
}

/** Between events time goes on: tick what counts seconds. */
setInterval(() => { if (job?.state === "running" && !document.hidden) showProgress(); }, 1000);
document.addEventListener("visibilitychange", () => { if (job && !document.hidden) showMade(); });

at("rename").addEventListener("click", () => {
  const field = h("input", { class: "input", maxlength: 200, value: job.label, "aria-label": "Label" });
  const before = at("name");
  const end = () => { field.replaceWith(before); at("rename").hidden = false; at("rename").focus(); };
  const save = async () => {
    try { onJob(await post(`/jobs/${id}/label`, { label: field.value.trim() })); } catch (error) { toast(error); }
    end();
  };
  field.addEventListener("keydown", (event) => { if (event.key === "Enter") save(); if (event.key === "Escape") end(); });
  at("rename").hidden = true;
  before.replaceWith(field);
  field.select();
  field.focus();
});

async function start() {
  try {
    const [found, lines] = await Promise.all([get(`/jobs/${id}`), get(`/jobs/${id}/log`, { limit: 2000 })]);
    job = found;
    picture.pixelSizePm = job.settings.metadata?.pixel_size_pm ?? null;
    for (const change of found.transitions) log.addTransition(change);
    for (const line of lines.lines.slice(-400)) log.add(line);
    show();
    throughput.show(job);
    showMade();
    subscribe(`/jobs/${id}/events`, { job: onJob, progress: onProgress, workers: onWorkers, log: (line) => log.add(line) }, { after: found.event });
    if (!hasEnded(job.state)) onWorkers(await get("/workers"));
    const { settings } = await get("/settings");
    defaults = new Map(settings.map((row) => [`${row.group}.${row.name}`, row.default]));
    showAbout();
  } catch (error) { toast(error); }
}

start();
