// The results of a job: the columns on the summed image, in time, and as a table; live while the job still fits.

import { get, subscribe, toast } from "./api.js";
import { histogram } from "./charts.js";
import { at, find, h, setAttribute, setText } from "./dom.js";
import { count, hasEnded, isDone, percent, several, significant, STATES } from "./format.js";
import { drawColourBar, scaleOf } from "./number_colours.js";
import { Displacements } from "./results_displacement.js";
import { ResultsMap } from "./results_map.js";
import { MOST, SeriesPanel } from "./results_series.js";
import { ColumnTable } from "./results_table.js";
import { showProvenance } from "./results_about.js";
import { showDownloads } from "./results_downloads.js";

/**
 * @import { Job, Summary } from "./api.js"
 * @import { Range } from "./chart_scale.js"
 * @import { Row } from "./column_map.js"
 * @typedef {{ label: string, unit: () => string, title?: string, of?: (row: Row) => number | null }} Quantity
 */

const REFRESH_MS = 2500;
const BINS = 24;
const ENOUGH = 0.5; // share of accepted fits, below which a column is not the one that is shown first

const job = document.body.dataset.job ?? "";
let unit = "pm", quantity = "sd";
let summary = /** @type {Summary | null} */ (null), rows = /** @type {Row[]} */ ([]);
let chosen = /** @type {number[]} */ ([]), picked = /** @type {Set<number> | null} */ (null);
let scale = /** @type {ReturnType<typeof scaleOf>} */ (null), spread = /** @type {ReturnType<typeof histogram> | null} */ (null);

/** @type {Record<string, Quantity>} */
const QUANTITIES = {
  sd: { label: "sd", unit: () => unit, title: "Standard deviation per axis (root mean square of x and y)" },
  sd_x: { label: "sd x", unit: () => unit },
  sd_y: { label: "sd y", unit: () => unit },
  accepted_share: { label: "accepted", unit: () => "%", of: (row) => (row.accepted_share === null ? null : 100 * row.accepted_share) },
  intensity: { label: "intensity", unit: () => "counts" },
};
/** @type {(row: Row) => number | null} */
const valueOf = (row) => (QUANTITIES[quantity].of ?? ((one) => one[quantity]))(row);
const labelOf = (/** @type {string} */ name) => `${QUANTITIES[name].label} (${QUANTITIES[name].unit()})`;

const map = new ResultsMap(at("map"), at("tip"), { job, onToggle: (row, event) => toggle(row.column_id, event), describe });
const series = new SeriesPanel({ job, onRemove: (id) => choose(chosen.filter((one) => one !== id)) });
const length = (name, label, title) => ({ name, label: () => `${label} (${unit})`, title, format: (row) => digits(row[name]) });
const digits = (value) => (value === null ? "–" : value.toPrecision(3)); // with its zeros, so that a column of them aligns
/** @type {ColumnTable | undefined} */
let table;
const arrows = new Displacements({ job, map, said: at("map-said") });

/** @param {Row} row */
function describe(row) {
  const kind = row.kind ? ` ${row.kind}` : "", lines = [
    `sd ${significant(row.sd)} ${unit} (x ${significant(row.sd_x)}, y ${significant(row.sd_y)})`,
    `accepted ${percent(row.accepted_share)}, intensity ${significant(row.intensity)} counts`,
  ];
  const moved = arrows.describe(row.column_id);
  return [`Column ${row.column_id}${kind}`, ...(moved ? [moved] : lines)];
}

/**
 * Show a column, or no longer; with Shift, Ctrl or Cmd beside the others.
 * @param {number} id
 * @param {MouseEvent} event
 */
function toggle(id, event) {
  const add = event.shiftKey || event.ctrlKey || event.metaKey;
  if (chosen.includes(id) && (add || chosen.length === 1)) choose(chosen.filter((one) => one !== id));
  else choose(add ? [...chosen, id] : [id]);
}

/** @param {number[]} ids */
function choose(ids) {
  chosen = ids.slice(-MOST);
  const done = series.choose(chosen);
  const styles = getComputedStyle(document.documentElement);
  const colours = new Map([...series.slots].map(([id, slot]) => [id, styles.getPropertyValue(`--series-${slot}`)]));
  map.show({ chosen: colours });
  table?.show({ chosen: colours });
  history.replaceState(null, "", chosen.length ? `#columns=${chosen.join(",")}` : location.pathname);
  return done;
}

/** The column that moves most against its stated error: worth the first look. */
function firstColumn() {
  const excess = (/** @type {Row} */ row) => (row.accepted_share >= ENOUGH && row.stated ? row.sd / row.stated : row.sd ?? -1);
  return rows.reduce((best, row) => (best === null || excess(row) > excess(best) ? row : best), /** @type {Row | null} */ (null))?.column_id;
}

function paint() {
  const found = scale = scaleOf(rows.map((row) => valueOf(row)));
  const colourOf = (/** @type {Row} */ row) => {
    const value = valueOf(row);
    return found && value !== null && Number.isFinite(value) ? found.colour(value) : null;
  };
  map.show({ rows, colourOf, picked });
  at("colour-bar").hidden = arrows.active;
  drawBar();
  const known = rows.map((row) => valueOf(row)).filter((value) => value !== null).filter(Number.isFinite);
  const { counts, edges } = binned(known);
  const changes = { edges, counts, xLabel: labelOf(quantity), yLabel: "columns", label: `Histogram of ${labelOf(quantity)}` };
  if (spread) spread.update(changes);
  else spread = histogram(at("histogram"), { height: 120, empty: "Nothing measured yet", onRange: pick, ...changes });
}

const drawBar = () => { if (!arrows.active) drawColourBar(at("colour-bar", HTMLCanvasElement), scale, labelOf(quantity)); };

/** @param {number[]} known */
function binned(known) {
  if (!known.length) return { counts: [], edges: [] };
  const low = Math.min(...known), high = Math.max(...known), width = (high - low || Math.abs(low) || 1) / BINS;
  const counts = new Array(BINS).fill(0);
  for (const value of known) counts[Math.min(BINS - 1, Math.floor((value - low) / width))] += 1;
  return { counts, edges: Array.from({ length: BINS + 1 }, (_, index) => low + index * width) };
}

/** @param {Range | null} range */
function pick(range) {
  const within = (/** @type {number | null} */ value) => range !== null && value !== null && value >= range[0] && value <= range[1];
  picked = range && new Set(rows.filter((row) => within(valueOf(row))).map((row) => row.column_id));
  map.show({ picked });
  table?.show({ picked });
}

/** @param {Summary} about */
function figures(about) {
  const median = (/** @type {string} */ name) => {
    const known = rows.map((row) => row[name]).filter((value) => value !== null).sort((a, b) => a - b);
    return known.length ? (known[(known.length - 1) >> 1] + known[known.length >> 1]) / 2 : null;
  };
  const tiles = [
    ["Frames", count(about.frames.done), about.complete ? "" : `of ${count(about.frames.total)}`],
    ["Columns", count(about.columns), ""],
    ["Fits accepted", percent(about.fits ? about.accepted / about.fits : null), `of ${count(about.fits)}`],
    ["sd, median", significant(median("sd")), unit],
    ["Stated error, median", significant(median("stated")), unit],
    ["Pixel", about.pixel_size_pm ? significant(about.pixel_size_pm, 4) : "not known", about.pixel_size_pm ? "pm" : ""],
    ["Frame time", about.frame_time_s ? significant(about.frame_time_s, 4) : "not known", about.frame_time_s ? "s" : ""],
  ];
  at("figures").replaceChildren(...tiles.map(([name, value, more]) => h("div", {}, h("dt", {}, name), h("dd", {}, value, " ", h("small", {}, more)))));
}

/** @param {Job} record */
function showState(record) {
  at("state").hidden = false;
  setAttribute(at("state"), "data-state", record.state);
  setText(at("state"), STATES[record.state]);
  at("report").hidden = !isDone(record.state);
  at("report", HTMLAnchorElement).href = `/api/v1/jobs/${job}/report`;
  showLive(record);
}

/** @param {Job} record */
function showLive(record) {
  at("live").hidden = !summary || summary.complete;
  if (!summary || summary.complete) return;
  find(".bar > span", undefined, at("live")).style.setProperty("--done", String(summary.frames.done / summary.frames.total));
  setText(at("live-text"), `${count(summary.shards.done)} of ${several(summary.shards.total, "shard")} fitted${hasEnded(record.state) ? "" : "; the rest comes by itself"}`);
}

function makeTable() {
  const fields = [
    { name: "column_id", label: "Column" }, { name: "kind", label: "Kind", text: true, format: (/** @type {Row} */ row) => row.kind || "–" },
    { name: "x", label: "x (px)", format: (row) => row.x.toFixed(2) }, { name: "y", label: "y (px)", format: (row) => row.y.toFixed(2) },
    length("sd", "sd", "Standard deviation per axis, root mean square of x and y"), length("sd_x", "sd x"), length("sd_y", "sd y"),
    length("stated", "Stated error", "Root mean square of the standard errors that the fits state"),
    { name: "accepted_share", label: "Accepted", format: (row) => percent(row.accepted_share) },
    { name: "intensity", label: "Intensity (counts)", format: (row) => significant(row.intensity, 4) },
  ].map((field) => ({ ...field, label: typeof field.label === "function" ? field.label() : field.label }));
  return new ColumnTable(at("table"), fields, { onToggle: toggle, said: at("table-said") });
}

/**
 * Read what is there now, and show it.
 * @param {Job} record
 */
async function refresh(record) {
  /** @type {Summary} */
  const newest = await get(`/jobs/${job}/results`);
  const first = summary === null;
  if (newest.version === summary?.version) return;
  const [numbers] = await Promise.all([get(`/jobs/${job}/results/columns`), map.load()]);
  summary = newest;
  [rows, unit] = [numbers.columns, numbers.unit];
  at("nothing").hidden = true;
  at("results").hidden = at("actions").hidden = false;
  table ??= makeTable();
  series.about(newest);
  arrows.about(newest);
  figures(newest);
  showLive(record);
  if (first) fillQuantities();
  paint();
  table.show({ rows });
  showDownloads(at("formats"), job, newest);
  showProvenance(newest, record);
  if (first) {
    const asked = /columns=([\d,]+)/.exec(location.hash)?.[1].split(",").map(Number).filter((id) => rows.some((row) => row.column_id === id));
    const start = firstColumn();
    await choose(asked?.length ? asked : start === undefined ? [] : [start]);
  } else await series.reload();
}

function fillQuantities() {
  const select = at("quantity", HTMLSelectElement);
  select.replaceChildren(...Object.keys(QUANTITIES).map((name) => h("option", { value: name, title: QUANTITIES[name].title }, labelOf(name))));
  select.onchange = () => {
    quantity = select.value;
    spread?.destroy(); // with its zoom, which is of the other quantity
    spread = null;
    pick(null);
    paint();
  };
  for (const button of modes()) button.onclick = () => setMode(button.dataset.mode ?? "");
}

const modes = () => /** @type {HTMLElement[]} */ ([...at("modes").children]);

/** @param {string} mode */
function setMode(mode) {
  for (const button of modes()) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  for (const element of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll('[data-for="numbers"]'))) element.hidden = mode !== "numbers";
  arrows.activate(mode === "arrows");
  paint();
}

/**
 * Say why there is nothing to see.
 * @param {any} error an ApiError, or any other
 * @param {{ state: string }} record
 */
function explain(error, record) {
  at("nothing").replaceChildren(
    h("h2", {}, error.status === 404 ? "No results yet" : error.what || "The results could not be read"),
    h("p", {}, error.status === 404 && !hasEnded(record.state) ? "They appear here as soon as the first frames are fitted." : error.remedy || error.message),
    h("a", { class: "button", href: `/jobs/${job}` }, "To the job"));
}

async function start() {
  let record = await get(`/jobs/${job}`), waiting = 0, working = /** @type {Promise<void> | null} */ (null);
  const update = async () => {
    waiting = 0;
    working = refresh(record).catch((error) => { if (summary) toast(error); else explain(error, record); });
    await working;
    working = null;
  };
  const soon = () => { waiting ||= setTimeout(() => (working ?? Promise.resolve()).then(update), REFRESH_MS); };
  showState(record);
  await update();
  if (hasEnded(record.state)) return;
  const close = subscribe(`/jobs/${job}/events`, {
    job: (data) => { if (data.deleted) return; record = { ...record, ...data }; showState(record); soon(); if (hasEnded(record.state)) close(); },
    progress: (data) => { if (data.stage === "fit") soon(); },
  }, { after: record.event });
}

const downloads = at("downloads", HTMLDetailsElement);
addEventListener("resize", drawBar);
document.addEventListener("themechange", () => { if (table) { choose(chosen); paint(); } });
document.addEventListener("click", (event) => { if (!downloads.contains(/** @type {Node} */ (event.target))) downloads.open = false; });
downloads.addEventListener("keydown", (event) => { if (event.key === "Escape") downloads.open = false; });
start().catch((error) => explain(error, { state: "" }));
