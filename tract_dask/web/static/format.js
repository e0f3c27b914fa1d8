// Numbers, times and states as people read them.

const LANGUAGE = "en";
const THIN = "\u202f"; // and no line ends there

const whole = new Intl.NumberFormat(LANGUAGE, { maximumFractionDigits: 0 });

/** A whole number with separators: 12,288. */
export const count = (value) => (finite(value) ? whole.format(value) : "–");

/** `count` items in words: "1 frame", "40 frames". */
export const several = (value, one, many = `${one}s`) => `${count(value)} ${value === 1 ? one : many}`;

/** A number to `digits` significant digits, without exponents where they do not help. */
export function significant(value, digits = 3) {
  if (!finite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e7 || size < 1e-4)) return value.toExponential(digits - 1).replace("e+", "e");
  return new Intl.NumberFormat(LANGUAGE, { maximumSignificantDigits: size >= 10 ** digits ? Math.ceil(Math.log10(size)) : digits }).format(value);
}

/** A rate with k and M: 1.24M, 36.1k, 480, 3.2. */
export function rate(value) {
  if (!finite(value)) return "–";
  const [scale, letter] = /** @type {[number, string]} */ (value >= 999.5e3 ? [1e6, "M"] : value >= 9995 ? [1e3, "k"] : [1, ""]);
  const scaled = value / scale;
  if (scaled >= 999.5) return whole.format(scaled);
  return scaled.toFixed(scaled >= 99.95 ? 0 : scaled >= 9.995 ? 1 : 2).replace(/^0\.00$/, "0") + letter;
}

/** Bytes in powers of 1000: 1.27 GB. */
export function bytes(value) {
  if (!finite(value)) return "–";
  let unit = 0;
  while (Math.abs(value) >= 999.5 && unit < 5) { value /= 1000; unit += 1; }
  return `${unit === 0 ? value : significant(value, 3)} ${["B", "kB", "MB", "GB", "TB", "PB"][unit]}`;
}

/** A share as percent: 95.7 %; never "100 %" where something is missing, nor "0 %" where there is something. */
export function percent(share, digits = 1) {
  if (!finite(share)) return "–";
  let text = (share * 100).toFixed(digits);
  const step = 10 ** -digits;
  if (share < 1 && Number(text) >= 100) text = (100 - step).toFixed(digits);
  if (share > 0 && Number(text) <= 0) text = step.toFixed(digits);
  if (share === 1 || share === 0) text = String(share * 100);
  return `${text}${THIN}%`;
}

/** A time span: 0.4 s, 38 s, 4 min 10 s, 2 h 5 min, 3 d 4 h. */
export function duration(seconds) {
  if (!finite(seconds)) return "–";
  if (seconds < 0.995) return `${significant(Math.max(seconds, 0), 2)} s`;
  if (seconds < 9.95) return `${seconds.toFixed(1)} s`;
  const total = Math.round(seconds);
  const parts = /** @type {[number, string][]} */ ([[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]]);
  const first = parts.findIndex(([size]) => total >= size);
  let rest = total;
  return parts.slice(first, first + 2).map(([size, unit]) => {
    const number = Math.floor(rest / size);
    rest -= number * size;
    return number ? `${number} ${unit}` : "";
  }).filter(Boolean).join(" ");
}

/** What is left, rounded such that it does not flicker: "about 4 min". */
export function left(seconds) {
  if (!finite(seconds)) return "–";
  if (seconds < 5) return "a few s";
  const step = seconds < 60 ? 5 : seconds < 600 ? 15 : seconds < 3600 ? 60 : 300;
  return duration(Math.ceil(seconds / step) * step);
}

const clock = new Intl.DateTimeFormat(LANGUAGE, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const clockWithSeconds = new Intl.DateTimeFormat(LANGUAGE, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const day = new Intl.DateTimeFormat(LANGUAGE, { day: "numeric", month: "short" });
const full = new Intl.DateTimeFormat(LANGUAGE, { dateStyle: "medium", timeStyle: "medium", hourCycle: "h23" });

/** The local time of an ISO time: "14:05" today, "21 Nov 14:05" before. */
export function moment(iso) {
  if (!iso) return "–";
  const time = new Date(iso);
  return time.toDateString() === new Date().toDateString() ? clock.format(time) : `${day.format(time)} ${clock.format(time)}`;
}

/** The local time of an ISO time with seconds: "14:05:09". */
export const timeOfDay = (iso) => (iso ? clockWithSeconds.format(new Date(iso)) : "–");

/** The whole local date and time, for titles. */
export const fullTime = (iso) => (iso ? full.format(new Date(iso)) : "");

/**
 * Seconds between two ISO times; without the second, until now.
 * @type {(start: string, stop?: string | null) => number}
 */
export const between = (start, stop = null) => ((stop ? new Date(stop) : new Date()).getTime() - new Date(start).getTime()) / 1000;

/** A state of a job in words. */
export const STATES = {
  queued: "Queued",
  running: "Running",
  waiting_for_columns: "Waiting for columns",
  done: "Done",
  done_with_failed_frames: "Done, some frames failed",
  failed: "Failed",
  cancelled: "Cancelled",
};

/** Whether a job in this state is over. */
export const hasEnded = (state) => ["done", "done_with_failed_frames", "failed", "cancelled"].includes(state);

/** Whether a job in this state has results of the whole movie. */
export const isDone = (state) => state === "done" || state === "done_with_failed_frames";

/** A stage in words, in the order of a run. */
export const STAGES = {
  convert: "Convert",
  drift: "Drift",
  sum: "Sum",
  columns: "Columns",
  fit: "Fit",
  report: "Report",
};

/** The name of a job: its label, else its file's name. */
export const nameOf = (job) => job.label || job.source.split("/").pop() || job.id;

/** @type {(value: unknown) => value is number} */
function finite(value) { return typeof value === "number" && Number.isFinite(value); }
