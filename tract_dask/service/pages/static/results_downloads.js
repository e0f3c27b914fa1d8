// Downloads: a Zarr store at once; other formats when the service has made the file.

import { get, toast, url } from "./api.js";
import { h, setText } from "./dom.js";
import { bytes } from "./format.js";

const ASK_MS = 1000;
const FORMATS = [
  { name: "zarr", title: "Zarr, zipped", text: "Everything; xarray opens it from the zip" },
  { name: "nc", title: "netCDF 4", text: "Everything in one file, for MATLAB and others" },
  { name: "csv", title: "CSV", text: "A row for every fit, for spreadsheets and R" },
];

/** @import { Summary } from "./api.js" */

/** @type {Set<string>} */
const working = new Set();

/**
 * Fill the menu; sizes are estimates until a file is made.
 * @param {HTMLElement} place
 * @param {string} job
 * @param {Summary} summary
 */
export function showDownloads(place, job, summary) {
  if (working.size) return; // a button that tells how far it is stays
  place.replaceChildren(...FORMATS.map((format) => {
    const size = h("span", { class: "size" }, `about ${bytes(summary.bytes[format.name])}`);
    const text = h("small", {}, `${format.text}${summary.complete ? "" : "; finished frames only"}`);
    const button = h("button", { type: "button", class: "format", dataset: { format: format.name } }, h("b", {}, format.title), size, text);
    button.addEventListener("click", () => download(job, format, button, size));
    return button;
  }));
}

/**
 * @param {string} job
 * @param {{ name: string }} format
 * @param {HTMLButtonElement} button
 * @param {HTMLElement} size
 */
async function download(job, format, button, size) {
  const place = `/jobs/${job}/results/download`, said = size.textContent;
  working.add(format.name);
  button.disabled = true;
  try {
    let answer = await get(place, { format: format.name, prepare: true });
    while (!answer.ready) {
      setText(size, "is being made …");
      await new Promise((resolve) => setTimeout(resolve, ASK_MS));
      answer = await get(place, { format: format.name, prepare: true });
    }
    setText(size, answer.bytes ? bytes(answer.bytes) : said);
    location.assign(url(place, { format: format.name }));
  } catch (error) {
    setText(size, said);
    toast(error);
  } finally {
    button.disabled = false;
    working.delete(format.name);
  }
}
