// Charts of a job: how fast it goes, and what the finished shards say of fits and drift.

import { lineChart } from "./charts.js";
import { duration, percent, rate, significant } from "./format.js";
import { timeline } from "./job_stages.js";

/**
 * @import { Job, Progress } from "./api.js"
 * @import { Series } from "./chart_paint.js"
 * @typedef {{ stage: string, elapsed: number, frames: number, fits: number | null }} Sample
 */

const MOST_SAMPLES = 2000;

/** Frames and fits a second over the run's working time: averages of finished stages, then what is seen live. */
export class Throughput {
  /** @param {HTMLElement} element */
  constructor(element) {
    /** @type {Sample[]} */
    this.samples = [];
    this.chart = lineChart(element, {
      label: "Throughput", height: 170, xLabel: "working time, s", xRange: [0, null], yRange: [0, null], rightRange: [0, null],
      empty: "Follows with the first shard", formatY: rate, formatX: duration, series: [],
    });
  }

  /**
   * Note a progress event.
   * @param {Progress} progress
   */
  add({ stage, frames_per_s: frames, fits_per_s: fits, stages }) {
    const record = stages?.[stage];
    if (!record || record.state !== "running" || frames === undefined || !Number.isFinite(frames)) return;
    this.samples.push({ stage, elapsed: record.seconds ?? 0, frames, fits: stage === "fit" ? fits ?? null : null });
    if (this.samples.length > MOST_SAMPLES) this.samples = this.samples.filter((_, index) => index % 2);
  }

  /** @param {Job} job */
  show(job) {
    const x = /** @type {number[]} */ ([]), frames = /** @type {(number | null)[]} */ ([]), fits = /** @type {(number | null)[]} */ ([]);
    const markers = /** @type {{ x: number, label: string }[]} */ ([]);
    /** @type {(time: number, one: number | null, other: number | null) => void} */
    const put = (time, one, other) => { x.push(time); frames.push(one); fits.push(other); };
    for (const { name, state, start, seconds, record } of timeline(job)) {
      if (state === "pending" || state === "reused" || !record.frames || seconds < 0.05) continue;
      markers.push({ x: start, label: name });
      const seen = this.samples.filter((sample) => sample.stage === name);
      if (seen.length > 1) for (const sample of seen) put(start + Math.min(sample.elapsed, seconds), sample.frames, sample.fits);
      else if (state === "done") {
        /** @type {[number, number | null]} */
        const average = [record.frames / seconds, name === "fit" && job.outcome.fits ? job.outcome.fits / seconds : null];
        put(start, ...average);
        put(start + seconds, ...average);
      }
      if (x.length) put(x[x.length - 1], null, null);
    }
    /** @type {Series[]} */
    const series = [{ name: "frames/s", x, y: frames, color: 1, kind: "area" }];
    if (fits.some((value) => value !== null)) series.push({ name: "fits/s", x, y: fits, color: 2, right: true });
    this.chart.update({ series, markers });
  }
}

/** The accepted share and the drift over the frames, as GET /jobs/ID/results/frames tells them. */
export class FrameCharts {
  /** @param {{ accepted: HTMLElement, drift: HTMLElement, note: HTMLElement }} places */
  constructor({ accepted, drift, note }) {
    const shared = { height: 150, xLabel: "time, s", series: [], empty: "Follows with the first fitted shard", group: "frames" };
    this.note = note;
    this.accepted = lineChart(accepted, { ...shared, label: "Share of fits that are accepted", yLabel: "%", yRange: [null, 100], formatY: (value) => `${significant(value, 4)} %` });
    this.drift = lineChart(drift, { ...shared, label: "Drift", yLabel: "pm" });
  }

  show(found) {
    const { t, time_unit: timeUnit, accepted_share: share, drift_x: x, drift_y: y, pixel_size_pm: size } = found;
    const xLabel = timeUnit === "s" ? "time, s" : "frame", unit = size ? "pm" : "px";
    const scaled = (values) => values.map((value) => (value === null ? null : value * (size ?? 1)));
    const formatX = (value) => (timeUnit === "s" ? duration(value) : `frame ${significant(value, 6)}`);
    const known = share.filter((value) => value !== null);
    this.note.textContent = known.length ? `mean ${percent(known.reduce((sum, value) => sum + value, 0) / known.length)}` : "";
    this.accepted.update({ xLabel, formatX, series: [{ name: "", x: t, y: share.map((value) => (value === null ? null : 100 * value)), color: 3, kind: "area", gaps: true }] });
    this.drift.update({ xLabel, formatX, yLabel: unit, series: [{ name: "x", unit, x: t, y: scaled(x), color: 1, gaps: true }, { name: "y", unit, x: t, y: scaled(y), color: 2, gaps: true }] });
  }
}
