// The API as the pages use it: requests, events that resume, and short messages to the user.

import { at } from "./dom.js";

/**
 * @typedef {{ state: string, frames?: number, done_frames: number, seconds: number | null, started?: string, summary?: string }} StageRecord
 * @typedef {object} Progress
 * @property {string} job
 * @property {string} stage
 * @property {number} fraction
 * @property {number} frames
 * @property {number} done_frames
 * @property {number} passes
 * @property {number} [frames_per_s]
 * @property {number} [fits_per_s]
 * @property {number} [seconds_left]
 * @property {Record<string, StageRecord>} [stages]
 * @typedef {object} Job
 * @property {string} id
 * @property {number} number
 * @property {string} label
 * @property {string} source
 * @property {string} owner
 * @property {string} output
 * @property {string} state
 * @property {string} stage
 * @property {string} reason
 * @property {number} attempts
 * @property {boolean} curate
 * @property {number | null} columns_version
 * @property {string} created
 * @property {string | null} started
 * @property {string | null} ended
 * @property {Record<string, Record<string, any>>} settings
 * @property {Progress} progress
 * @property {{ frames?: number, columns?: number, fits?: number, accepted?: number, bad_frames?: number }} outcome
 * @property {boolean} [deleted] only in events
 * @typedef {object} Levels of an image: black, white and all between
 * @property {[number, number] | null} range
 * @property {Record<string, number> | null} percentiles
 * @property {number[]} counts
 * @property {number[]} edges
 * @typedef {object} Movie
 * @property {string} path
 * @property {[number, number, number]} shape
 * @property {string} dtype
 * @property {number} bytes
 * @property {string} format
 * @property {number} files
 * @property {number | null} pixel_size_pm
 * @property {number | null} frame_time_s
 * @property {number | null} dose
 * @property {number | null} gain
 * @property {number | null} file_pixel_size_pm
 * @property {number | null} file_frame_time_s
 * @property {boolean} time_stamps
 * @property {string[]} warnings
 * @typedef {object} Summary of results
 * @property {string} version
 * @property {boolean} complete
 * @property {{ done: number, total: number }} shards
 * @property {{ done: number, total: number }} frames
 * @property {number} columns
 * @property {number} fits
 * @property {number} accepted
 * @property {number | null} pixel_size_pm
 * @property {number | null} frame_time_s
 * @property {number | null} dose
 * @property {string} unit
 * @property {number} last_time
 * @property {string} time_unit
 * @property {number | null} window_px
 * @property {string | null} created
 * @property {Record<string, string>} versions
 * @property {Record<string, Record<string, any>>} settings
 * @property {Record<string, number>} bytes
 * @typedef {{ what: string, where: string, expected: string, got: string, remedy: string, text?: string }} Refusal
 */

const PREFIX = new URL("../api/v1", import.meta.url).pathname; // beside this file, under whatever address
const LOST_AFTER_MS = 2500; // a connection that is back sooner was never missed
const HIDDEN_MS = 10_000; // a tab that nobody sees gives its stream back: browsers allow six connections to a server
const RETRY_MS = [500, 1000, 2000, 4000, 8000];

/** What the service refused, in the parts of a TractError: what, where, expected, got, remedy. */
export class ApiError extends Error {
  /**
   * @param {number} status
   * @param {Partial<Refusal>} parts
   */
  constructor(status, parts) {
    super(parts.text || parts.what || `The service answered with status ${status}`);
    this.name = "ApiError";
    this.status = status;
    this.what = parts.what ?? "";
    this.where = parts.where ?? "";
    this.expected = parts.expected ?? "";
    this.got = parts.got ?? "";
    this.remedy = parts.remedy ?? "";
    this.text = parts.text;
  }
}

/**
 * The address of a path of the API, such as `url("/files", { path: "a b" })`; empty parameters are left out.
 * @param {string} path
 * @param {Record<string, any>} params
 */
export function url(path, params = {}) {
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(params)) {
    for (const item of Array.isArray(value) ? value : [value]) {
      if (item !== undefined && item !== null && item !== "") query.append(name, item);
    }
  }
  const text = query.toString();
  return PREFIX + path + (text ? `?${text}` : "");
}

/** @typedef {{ signal?: AbortSignal }} Options */

/**
 * GET; `options.signal` aborts.
 * @param {string} path
 * @param {Record<string, any>} [params]
 * @param {Options} [options]
 */
export const get = (path, params, options = {}) => request("GET", url(path, params), undefined, options);
/**
 * POST of a JSON body.
 * @param {string} path
 * @param {object} [body]
 * @param {Options} [options]
 */
export const post = (path, body = {}, options = {}) => request("POST", url(path), body, options);
/**
 * DELETE.
 * @param {string} path
 * @param {Record<string, any>} [params]
 */
export const del = (path, params) => request("DELETE", url(path, params), undefined);

/**
 * @param {string} method
 * @param {string} address
 * @param {object | undefined} body
 * @param {Options} [options]
 */
async function request(method, address, body, { signal } = {}) {
  /** @type {Record<string, string>} */
  const headers = { Accept: "application/json" };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(address, { method, headers, signal, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ApiError(0, { what: "The service does not answer", remedy: "Check that it runs and that the network is up; nothing was lost" });
  }
  if (response.status === 401) logIn();
  const text = await response.text();
  const answer = text && response.headers.get("content-type")?.includes("json") ? JSON.parse(text) : text;
  if (!response.ok) throw new ApiError(response.status, answer?.error ?? {});
  return answer;
}

/** Go to the login page, and from there back to here. */
export function logIn() {
  location.assign(`/login?next=${encodeURIComponent(location.pathname + location.search)}`);
}

/**
 * Follow a stream of events: `subscribe("/events", { job: (data) => …, progress: (data) => … })`.
 * Each handler gets the event's data, already parsed. Resumes after the last event that was seen, also where the
 * service was away, and shows a banner while it is; rests while nobody sees the page. Returns a function that ends it.
 * @param {string} path
 * @param {Record<string, (data: any) => void>} handlers
 * @param {Record<string, any>} params
 */
export function subscribe(path, handlers, params = {}) {
  let source = /** @type {EventSource | null} */ (null), last = /** @type {string | null} */ (null);
  let attempt = 0, timer = 0, resting = 0, ended = false;
  const connection = {};

  function open() {
    const opened = new EventSource(url(path, last === null ? params : { ...params, after: last }));
    source = opened;
    opened.onopen = () => { attempt = 0; lost.delete(connection); showBanner(); };
    opened.onerror = () => {
      if (!lost.has(connection)) lost.set(connection, setTimeout(showBanner, LOST_AFTER_MS));
      if (opened.readyState === EventSource.CLOSED) again();
    };
    for (const [kind, handle] of Object.entries(handlers)) {
      opened.addEventListener(kind, (event) => {
        if (event.lastEventId) last = event.lastEventId;
        handle(JSON.parse(event.data));
      });
    }
  }

  // EventSource gives up where the answer is not a stream: an expired login, or a service that is starting
  function again() {
    clearTimeout(timer);
    timer = setTimeout(async () => {
      try { await get("/health"); } catch (error) { if (error.status !== 503) { if (!ended) again(); return; } }
      if (!ended) open();
    }, RETRY_MS[Math.min(attempt++, RETRY_MS.length - 1)]);
  }

  function close() {
    clearTimeout(timer);
    source?.close();
    source = null;
    lost.delete(connection);
    showBanner();
  }

  function look() {
    clearTimeout(resting);
    if (document.hidden) resting = setTimeout(close, HIDDEN_MS);
    else if (!source) open();
  }

  document.addEventListener("visibilitychange", look);
  look();
  return () => {
    ended = true;
    document.removeEventListener("visibilitychange", look);
    clearTimeout(resting);
    close();
  };
}

/** @type {Map<object, number>} */
const lost = new Map(); // connection -> timer of its banner

function showBanner() {
  const banner = document.getElementById("banner");
  if (!banner) return;
  banner.hidden = lost.size === 0;
  banner.textContent = lost.size ? "The connection to the service is lost. What you see is from before; it comes back by itself." : "";
}

addEventListener("pagehide", () => { for (const timer of lost.values()) clearTimeout(timer); });

/**
 * Say something briefly: kind "good", "bad" or "". An ApiError shows what is wrong and what to do.
 * @param {string | Error} message
 */
export function toast(message, kind = "") {
  const error = message instanceof Error ? message : null, { what, remedy } = message instanceof ApiError ? message : { what: "", remedy: "" };
  const element = document.createElement("div");
  element.className = `toast ${error ? "bad" : kind}`;
  element.setAttribute("role", error || kind === "bad" ? "alert" : "status");
  const text = document.createElement("div");
  text.append(message instanceof Error ? what || message.message : message);
  if (remedy) text.append(Object.assign(document.createElement("div"), { className: "muted", textContent: remedy }));
  const close = Object.assign(document.createElement("button"), { type: "button", className: "icon", textContent: "×" });
  close.setAttribute("aria-label", "Close this message");
  close.onclick = () => element.remove();
  element.append(text, close);
  at("toasts").append(element);
  setTimeout(() => element.remove(), error || kind === "bad" ? 12000 : 5000);
}
