// How it was measured: what is known of the movie, versions, and every setting.

import { get } from "./api.js";
import { at, h } from "./dom.js";
import { count, fullTime, significant } from "./format.js";

/**
 * @import { Job, Summary } from "./api.js"
 * @import { Declared } from "./settings_form.js"
 */

let declared = /** @type {Declared[] | { settings: Declared[] } | null} */ (null);

/**
 * Show where the results come from.
 * @param {Summary} summary
 * @param {Job} record
 */
export async function showProvenance(summary, record) {
  const known = (value, unit) => (value ? `${significant(value, 4)} ${unit}` : "not known");
  const facts = [
    ["Movie", record.source],
    ["Frames", `${count(summary.frames.total)}, ${known(summary.frame_time_s, "s each")}`],
    ["Pixel", known(summary.pixel_size_pm, "pm")],
    ["Dose", summary.dose ? known(summary.dose, "e/Å² a frame") : "not known"],
    ["Window", summary.window_px ? `${summary.window_px} px` : "–"],
    ["Fitted", summary.created ? `from ${fullTime(summary.created)}` : "–"],
    ["Folder", record.output],
    ["Versions", Object.entries(summary.versions).map(([name, version]) => `${name} ${version}`).join(", ")],
  ];
  at("facts").replaceChildren(...facts.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value ?? "–")]));
  declared ??= await get("/settings").catch(() => null);
  at("settings").replaceChildren(...settingRows(summary.settings));
}

/** @param {Summary["settings"]} settings */
function settingRows(settings) {
  const rows = Array.isArray(declared) ? declared : declared?.settings ?? [];
  const about = new Map(rows.map((row) => [`${row.group}.${row.name}`, row]));
  return Object.entries(settings).map(([group, values]) => h("tbody", {},
    h("tr", { class: "group" }, h("th", { colspan: 3, scope: "rowgroup" }, rows.find((row) => row.group === group)?.title ?? group)),
    ...Object.entries(values).map(([name, value]) => {
      const row = about.get(`${group}.${name}`);
      const changed = row && JSON.stringify(value) !== JSON.stringify(row.default);
      return h("tr", changed ? { "data-changed": true } : {}, h("td", { class: "mono" }, `${group}.${name}`),
        h("td", {}, `${text(value)}${row?.unit ? ` ${row.unit}` : ""}`), h("td", { class: "muted" }, row?.description ?? ""));
    })));
}

const text = (value) => (typeof value === "boolean" ? (value ? "on" : "off") : Array.isArray(value) ? value.join(", ") : String(value));
