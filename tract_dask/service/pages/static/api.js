// The API as the pages use it: requests, events that resume, and short messages to the user.

const PREFIX = new URL("../api/v1", import.meta.url).pathname; // beside this file, under whatever address
const LOST_AFTER_MS = 2500; // a connection that is back sooner was never missed
const HIDDEN_MS = 10_000; // a tab that nobody sees gives its stream back: browsers allow six connections to a server
const RETRY_MS = [500, 1000, 2000, 4000, 8000];

/** What the service refused, in the parts of a TractError: what, where, expected, got, remedy. */
export class ApiError extends Error {
  constructor(status, parts) {
    super(parts.text || parts.what || `The service answered with status ${status}`);
    this.name = "ApiError";
    this.status = status;
    Object.assign(this, { what: "", where: "", expected: "", got: "", remedy: "" }, parts);
  }
}

/** The address of a path of the API, such as `url("/files", { path: "a b" })`; empty parameters are left out. */
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

/** GET; `options.signal` aborts. */
export const get = (path, params, options = {}) => request("GET", url(path, params), undefined, options);
/** POST of a JSON body. */
export const post = (path, body = {}, options = {}) => request("POST", url(path), body, options);
/** DELETE. */
export const del = (path, params) => request("DELETE", url(path, params));

async function request(method, address, body, { signal } = {}) {
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
 */
export function subscribe(path, handlers, params = {}) {
  let source = null, last = null, attempt = 0, timer = 0, resting = 0, ended = false;
  const connection = {};

  function open() {
    source = new EventSource(url(path, last === null ? params : { ...params, after: last }));
    source.onopen = () => { attempt = 0; lost.delete(connection); showBanner(); };
    source.onerror = () => {
      if (!lost.has(connection)) lost.set(connection, setTimeout(showBanner, LOST_AFTER_MS));
      if (source.readyState === EventSource.CLOSED) again();
    };
    for (const [kind, handle] of Object.entries(handlers)) {
      source.addEventListener(kind, (event) => {
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

const lost = new Map(); // connection -> timer of its banner

function showBanner() {
  const banner = document.getElementById("banner");
  if (!banner) return;
  banner.hidden = lost.size === 0;
  banner.textContent = lost.size ? "The connection to the service is lost. What you see is from before; it comes back by itself." : "";
}

addEventListener("pagehide", () => { for (const timer of lost.values()) clearTimeout(timer); });

/** Say something briefly: kind "good", "bad" or "". An ApiError shows what is wrong and what to do. */
export function toast(message, kind = "") {
  const place = document.getElementById("toasts");
  const error = message instanceof Error ? message : null;
  const element = document.createElement("div");
  element.className = `toast ${error ? "bad" : kind}`;
  element.setAttribute("role", error || kind === "bad" ? "alert" : "status");
  const text = document.createElement("div");
  text.append(error ? error.what || error.message : message);
  if (error?.remedy) text.append(Object.assign(document.createElement("div"), { className: "muted", textContent: error.remedy }));
  const close = Object.assign(document.createElement("button"), { type: "button", className: "icon", textContent: "×" });
  close.setAttribute("aria-label", "Close this message");
  close.onclick = () => element.remove();
  element.append(text, close);
  place.append(element);
  setTimeout(() => element.remove(), error || kind === "bad" ? 12000 : 5000);
}
