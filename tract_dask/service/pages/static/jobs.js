// The list of jobs: one row a job, made once and then updated in place as events come.

import { get, subscribe, toast } from "./api.js";
import { at, h, setAttribute, setText } from "./dom.js";
import { count, duration, fullTime, hasEnded, isDone, left, moment, nameOf, percent, rate, several, between, STAGES, STATES } from "./format.js";
import { actionButton, actionsOf, isCancelling } from "./job_actions.js";

/**
 * @import { Job, Progress } from "./api.js"
 * @typedef {{ name: string, title: string, states?: string[] }} Group
 */

const ACTIVE = ["running", "waiting_for_columns"];
/** @type {Group[]} */
const GROUPS = [
  { name: "", title: "All" },
  { name: "running", title: "Running", states: ["running"] },
  { name: "queued", title: "Queued", states: ["queued"] },
  { name: "waiting", title: "Waiting for columns", states: ["waiting_for_columns"] },
  { name: "done", title: "Done", states: ["done", "done_with_failed_frames"] },
  { name: "failed", title: "Failed", states: ["failed"] },
  { name: "cancelled", title: "Cancelled", states: ["cancelled"] },
];
const PAGE = 50;

const [list, active, others, nothing, olderRow, said] = ["list", "active", "others", "nothing", "older-row", "said"].map((id) => at(id));
const address = new URLSearchParams(location.search);
const filter = { group: address.get("state") ?? "", owner: address.get("owner") ?? "", text: address.get("text") ?? "" };
/** @type {Map<string, Row>} */
const rows = new Map(); // by id
/** @type {Set<string>} */
const owners = new Set();
let next = /** @type {number | null} */ (null), counts = /** @type {Record<string, number>} */ ({}), generation = 0;

const group = () => GROUPS.find((one) => one.name === filter.group) ?? GROUPS[0];
const states = () => group().states ?? [];

/** One job's row; `update` touches only what changed. */
class Row {
  /** @param {Job} job */
  constructor(job) {
    this.job = job;
    this.drawn = "";
    this.badge = h("span", { class: "badge" });
    this.name = h("a", { class: "name", href: `/jobs/${job.id}` });
    this.path = h("bdi", { dir: "ltr" });
    this.source = h("span", { class: "sub path" }, this.path);
    this.fill = h("span", {});
    this.bar = h("div", { class: "bar", role: "progressbar", "aria-valuemin": 0, "aria-valuemax": 100 }, this.fill);
    this.result = h("span", { class: "one-line" });
    this.where = h("span", { class: "sub tabular" });
    this.speed = h("span", {});
    this.fits = h("span", { class: "sub" });
    this.time = h("span", {});
    this.timeNote = h("span", { class: "sub" });
    this.submitted = h("span", { class: "tabular" });
    this.owner = h("span", { class: "sub" });
    this.actions = h("div", { class: "actions" });
    const cell = (kind, ...content) => h("td", { class: kind }, ...content);
    this.element = h("tr", { dataset: { job: job.id } },
      cell("c-state", this.badge), cell("", this.name, this.source), cell("c-progress", this.bar, this.result, this.where),
      cell("c-speed number", this.speed, this.fits), cell("c-time number", this.time, this.timeNote),
      cell("c-submitted", this.submitted, this.owner), cell("c-actions", this.actions));
    this.update(job);
  }

  /** @param {Job} job */
  update(job) {
    this.job = job;
    const name = nameOf(job);
    setAttribute(this.badge, "data-state", job.state);
    setText(this.badge, isCancelling(job) ? "Cancelling" : job.state === "done_with_failed_frames" ? "Done, with failures" : STATES[job.state]);
    setAttribute(this.badge, "title", STATES[job.state]);
    setText(this.name, name);
    setAttribute(this.name, "title", name);
    setText(this.path, job.source);
    setAttribute(this.source, "title", job.source);
    setText(this.submitted, moment(job.created));
    setAttribute(this.submitted, "title", fullTime(job.created));
    setText(this.owner, job.owner);
    setAttribute(this.owner, "title", job.owner);
    this.updateProgress(job.progress);
    this.updateActions();
  }

  /** @param {Progress} progress */
  updateProgress(progress) {
    const { job } = this;
    job.progress = progress;
    const { fraction = 0 } = progress, running = job.state === "running";
    this.bar.hidden = isDone(job.state);
    setText(this.result, isDone(job.state) ? resultText(job.outcome) : "");
    this.fill.style.setProperty("--done", String(fraction));
    setAttribute(this.bar, "class", `bar ${barKind(job)}`);
    setAttribute(this.bar, "aria-valuenow", Math.round(fraction * 100));
    setAttribute(this.bar, "aria-label", `Progress of ${nameOf(job)}`);
    setText(this.where, whereText(job));
    setAttribute(this.where, "title", whereText(job));
    setAttribute(this.where, "class", `sub tabular${job.state === "failed" ? " bad" : ""}`);
    setText(this.speed, running && progress.frames_per_s ? `${rate(progress.frames_per_s)} frames/s` : "");
    setText(this.fits, running && progress.fits_per_s ? `${rate(progress.fits_per_s)} fits/s` : "");
    const [time, note] = timeTexts(job);
    setText(this.time, time);
    setText(this.timeNote, note);
  }

  updateActions() {
    const { job } = this;
    const actions = actionsOf(job);
    const wanted = [job.state, ...actions].join();
    if (this.drawn === wanted) return;
    this.drawn = wanted;
    const links = [];
    if (job.state === "waiting_for_columns") links.push(h("a", { class: "button small primary", href: `/jobs/${job.id}/columns` }, "Check columns"));
    if (isDone(job.state)) links.push(h("a", { class: "button small", href: `/jobs/${job.id}/results` }, "Results"));
    const buttons = actions.map((action) => actionButton(job, action, (done) => { if (done === "delete") drop(job.id); }));
    this.actions.replaceChildren(...links, ...buttons);
  }
}

/** @param {Job} job */
function barKind(job) {
  return { done: "good", done_with_failed_frames: "warn", failed: "bad", cancelled: "still", waiting_for_columns: "warn" }[job.state] ?? "";
}

/** @param {Job} job */
function whereText(job) {
  const { progress, outcome, state } = job;
  if (state === "failed") return job.reason || "Failed";
  if (state === "cancelled") return job.reason || "Cancelled";
  if (state === "waiting_for_columns") return "Check the columns to go on";
  if (state === "queued") return job.reason && job.attempts ? `In the queue: ${job.reason}` : "In the queue";
  if (isDone(state)) return outcome.fits ? `${percent((outcome.accepted ?? NaN) / outcome.fits)} of ${rate(outcome.fits)} fits accepted` : "";
  const stage = STAGES[progress.stage || job.stage] ?? "Starting";
  return progress.frames ? `${stage} · ${count(progress.done_frames)} of ${several(progress.frames, "frame")}` : stage;
}

/** @param {Job["outcome"]} outcome */
function resultText({ frames, columns, bad_frames: bad }) {
  const parts = [bad && `${several(bad, "frame")} failed`, frames && several(frames, "frame"), columns && several(columns, "column")];
  return parts.filter(Boolean).join(" · ");
}

/** @param {Job} job */
function timeTexts(job) {
  if (job.state === "running") {
    const { seconds_left: seconds, fraction } = job.progress;
    return [seconds !== undefined && Number.isFinite(seconds) ? left(seconds) : "", Number.isFinite(seconds) ? "left" : fraction ? percent(fraction, 0) : ""];
  }
  if (hasEnded(job.state) && job.started && job.ended) return [duration(between(job.started, job.ended)), "taken"];
  return ["", ""];
}

/**
 * Put a job's row where it belongs: those that need eyes first where all are shown, then the newest first.
 * @param {Job} job
 */
function place(job, fresh = false) {
  if (!matches(job)) { drop(job.id); return; }
  let row = rows.get(job.id);
  if (row) row.update(job);
  else {
    row = new Row(job);
    rows.set(job.id, row);
    if (fresh) row.element.classList.add("new");
  }
  const body = !group().states && ACTIVE.includes(job.state) ? active : others;
  const { element } = row, neighbours = /** @type {HTMLElement[]} */ ([...body.children]).filter((one) => one !== element);
  const after = neighbours.find((one) => (rows.get(one.dataset.job ?? "")?.job.number ?? Infinity) < job.number) ?? null;
  if (element.parentElement !== body || element.nextElementSibling !== after) body.insertBefore(element, after);
  if (!owners.has(job.owner)) { owners.add(job.owner); showOwners(); }
  showNothing();
}

/** @param {string} id */
function drop(id) {
  rows.get(id)?.element.remove();
  if (rows.delete(id)) showNothing();
}

/** @param {Job} job */
function matches(job) {
  const text = filter.text.toLowerCase();
  return (!states().length || states().includes(job.state)) && (!filter.owner || job.owner === filter.owner)
    && (!text || [job.label, job.source, job.owner, job.id].some((part) => part.toLowerCase().includes(text)));
}

const query = () => ({ owner: filter.owner, text: filter.text });

/** Read the list anew, and follow it from there. */
let stop = () => {};
async function load() {
  const mine = ++generation;
  list.setAttribute("aria-busy", "true");
  try {
    const [first, page] = await Promise.all([
      group().states ? { jobs: [] } : get("/jobs", { ...query(), state: ACTIVE, limit: 200 }),
      get("/jobs", { ...query(), state: states(), limit: PAGE }),
    ]);
    if (mine !== generation) return;
    stop();
    for (const id of [...rows.keys()]) if (![...first.jobs, ...page.jobs].some((job) => job.id === id)) drop(id);
    ({ next, counts } = page);
    for (const job of [...first.jobs, ...page.jobs]) place(job);
    stop = subscribe("/events", { job: onJob, progress: onProgress }, { after: first.event ? Math.min(first.event, page.event) : page.event });
    list.setAttribute("aria-busy", "false");
    showStates();
    showNothing();
  } catch (error) {
    if (mine !== generation) return;
    nothing.hidden = false;
    nothing.replaceChildren(h("div", { class: "empty" }, h("h2", {}, error.what || "The list could not be read"), h("p", {}, error.remedy), h("button", { class: "button", type: "button", onclick: load }, "Try again")));
  }
}

async function loadOlder() {
  const button = at("older", HTMLButtonElement), mine = generation;
  button.disabled = true;
  try {
    const page = await get("/jobs", { ...query(), state: states(), limit: PAGE, before: next });
    if (mine !== generation) return;
    next = page.next;
    for (const job of page.jobs) place(job);
    showNothing();
  } catch (error) { toast(error); }
  button.disabled = false;
}

/** @param {Job} job */
function onJob(job) {
  if (job.deleted) { drop(job.id); recount(); return; }
  const before = rows.get(job.id)?.job;
  const oldest = [...rows.values()].reduce((least, row) => Math.min(least, row.job.number), Infinity);
  if (before || !next || job.number > oldest || ACTIVE.includes(job.state)) place(job, !before);
  if (before?.state === job.state) return;
  recount();
  if (before) setText(said, `${nameOf(job)}: ${STATES[job.state]}`);
}

/** @param {Progress} progress */
function onProgress(progress) {
  const row = rows.get(progress.job);
  if (row) row.updateProgress(progress);
}

let recounting = 0;
function recount() {
  clearTimeout(recounting);
  recounting = setTimeout(async () => {
    try { ({ counts } = await get("/jobs", { ...query(), limit: 1 })); showStates(); showNothing(); } catch { /* the next event counts again */ }
  }, 400);
}

const stateButtons = new Map(GROUPS.map((one) => {
  const number = h("b", {});
  const button = h("button", { type: "button", onclick: () => choose({ group: one.name }) }, one.title, number);
  return [one.name, { button, number }];
}));
at("states").append(...[...stateButtons.values()].map(({ button }) => button));

function showStates() {
  for (const one of GROUPS) {
    const { button, number } = /** @type {{ button: HTMLElement, number: HTMLElement }} */ (stateButtons.get(one.name));
    const total = (one.states ?? Object.keys(STATES)).reduce((sum, state) => sum + (counts[state] ?? 0), 0);
    setText(number, count(total));
    setAttribute(button, "aria-pressed", String(one.name === group().name));
  }
}

function showOwners() {
  const select = at("owner");
  if (filter.owner) owners.add(filter.owner);
  const names = [...owners].sort((one, other) => one.localeCompare(other));
  select.replaceChildren(h("option", { value: "" }, "All owners"), ...names.map((name) => h("option", { value: name, selected: name === filter.owner }, name)));
  select.hidden = names.length < 2 && !filter.owner;
}

function showNothing() {
  olderRow.hidden = next === null || list.getAttribute("aria-busy") === "true";
  const empty = rows.size === 0 && list.getAttribute("aria-busy") === "false";
  at("scroll").hidden = empty;
  nothing.hidden = !empty;
  if (!empty) return;
  const filtered = filter.group || filter.owner || filter.text;
  nothing.replaceChildren(filtered
    ? h("div", { class: "empty" }, h("h2", {}, "No job is like that"), h("p", {}, "Nothing has this state, owner and text."), h("button", { class: "button", type: "button", onclick: () => choose({ group: "", owner: "", text: "" }) }, "Show all jobs"))
    : h("div", { class: "empty" }, lattice(), h("h2", {}, "No jobs yet"), h("p", {}, "Choose a movie under the data root; tract_dask finds its atomic columns and follows each through every frame."), h("a", { class: "button primary large", href: "/new" }, "New job")));
}

function lattice() {
  return h("img", { src: "/static/logo.svg", width: 56, height: 56, alt: "" });
}

/** @param {Partial<typeof filter>} changes */
function choose(changes) {
  Object.assign(filter, changes);
  at("text", HTMLInputElement).value = filter.text;
  at("owner", HTMLSelectElement).value = filter.owner;
  const shown = new URLSearchParams(Object.entries({ state: filter.group, owner: filter.owner, text: filter.text }).filter(([, value]) => value));
  history.replaceState(null, "", shown.size ? `?${shown}` : location.pathname);
  showStates();
  load();
}

let typing = 0;
at("text", HTMLInputElement).value = filter.text;
at("text").addEventListener("input", () => {
  clearTimeout(typing);
  typing = setTimeout(() => choose({ text: at("text", HTMLInputElement).value.trim() }), 250);
});
at("owner").addEventListener("change", () => choose({ owner: at("owner", HTMLSelectElement).value }));
at("filters").addEventListener("submit", (event) => event.preventDefault());
at("older").addEventListener("click", loadOlder);
showOwners();
showStates();
load();
