// A browser of the folders under the data root, in which movies stand out.

import { get } from "./api.js";
import { h } from "./dom.js";
import { bytes, moment, fullTime, several } from "./format.js";

const ICONS = {
  folder: "M2.5 5.5v9a1 1 0 0 0 1 1h13a1 1 0 0 0 1-1V7a1 1 0 0 0-1-1H10L8.3 4.5H3.5a1 1 0 0 0-1 1z",
  movie: "M3 4.5h14v11H3zM6 4.5v11M14 4.5v11M3 8h3M3 12h3M14 8h3M14 12h3",
  file: "M5 3h6l4 4v10H5zM11 3v4h4",
};

/** @typedef {{ name: string, path: string, kind: "folder" | "movie" | "file" | "unusable", bytes: number | null, modified: string }} Entry */

/** Shows `element` a folder at a time; `onMovie(path)` when a movie is chosen, `onFolder(path)` when a folder is opened. */
export class FolderBrowser {
  /**
   * @param {HTMLElement} element
   * @param {{ onMovie: (path: string) => void, onFolder: (path: string) => void }} options
   */
  constructor(element, { onMovie, onFolder }) {
    this.onMovie = onMovie;
    this.onFolder = onFolder;
    this.path = "";
    /** @type {Entry[]} */
    this.entries = [];
    /** @type {string | null} */
    this.next = null;
    this.crumbs = h("nav", { class: "crumbs", "aria-label": "Folder" });
    this.filter = h("input", { class: "input", type: "search", placeholder: "Filter by name", "aria-label": "Filter by name", autocomplete: "off", oninput: () => this.show() });
    this.asOne = h("button", { type: "button", class: "button", id: "as-one", hidden: true, title: "The files of the folder, in the order of the numbers in their names", onclick: () => this.onMovie(this.path) }, "Open the folder as one movie");
    this.body = h("tbody", {});
    this.note = h("div", {});
    this.scroll = h("div", { class: "files scroll" },
      h("table", { class: "table" },
        h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Name"), h("th", { scope: "col", class: "number" }, "Size"), h("th", { scope: "col", class: "number" }, "Changed"))),
        this.body),
      this.note);
    this.typed = h("input", { class: "input mono", id: "typed", autocomplete: "off", spellcheck: "false", placeholder: "folder/file.h5::/path/in/file, a folder of images, or scan_*.tif" });
    element.replaceChildren(h("div", { class: "browse-bar" }, this.crumbs, this.filter, this.asOne), this.scroll,
      h("form", { class: "by-hand", onsubmit: (event) => this.takeTyped(event) },
        h("div", { class: "field" }, h("label", { for: "typed" }, "Or type a path under the data root"), this.typed),
        h("button", { class: "button" }, "Open")));
  }

  /**
   * Read and show a folder; "" is the data root.
   * @param {string} path
   */
  async open(path, note = true) {
    const mine = this.opening = Symbol(path);
    if (note) this.onFolder(path);
    this.showCrumbs(path);
    const slow = setTimeout(() => this.note.replaceChildren(h("p", { class: "empty" }, "Reading the folder …")), 300);
    try {
      const { entries, next } = await get("/files", { path });
      if (this.opening !== mine) return;
      [this.path, this.entries, this.next] = [path, entries, next];
      this.filter.value = "";
      this.show();
      this.scroll.scrollTop = 0;
    } catch (error) {
      if (this.opening !== mine) return;
      this.body.replaceChildren();
      this.note.replaceChildren(h("div", { class: "empty" }, h("h2", {}, error.what), h("p", {}, error.remedy), path && h("button", { type: "button", class: "button", onclick: () => this.open("") }, "To the data root")));
    } finally {
      clearTimeout(slow);
    }
  }

  /**
   * Read the next page of the folder, and show it with those before.
   * @param {HTMLButtonElement} button
   */
  async more(button) {
    const mine = this.opening;
    button.disabled = true;
    try {
      const { entries, next } = await get("/files", { path: this.path, after: this.next });
      if (this.opening !== mine) return;
      [this.entries, this.next] = [[...this.entries, ...entries], next];
      this.show();
    } catch (error) {
      if (this.opening === mine) button.replaceWith(h("p", { class: "empty" }, `${error.what}. ${error.remedy}`));
    }
  }

  takeTyped(event) {
    event.preventDefault();
    const path = this.typed.value.trim().replace(/^\/+/, "");
    if (path) this.onMovie(path);
  }

  showCrumbs(path) {
    const parts = path.split("/").filter(Boolean);
    const crumb = (name, to, last) => h("button", { type: "button", "aria-current": last ? "location" : null, onclick: () => this.open(to) }, name);
    const items = /** @type {HTMLElement[]} */ ([crumb("Data root", "", parts.length === 0)]);
    parts.forEach((name, index) => items.push(h("span", { class: "muted", "aria-hidden": "true" }, "/"), crumb(name, parts.slice(0, index + 1).join("/"), index === parts.length - 1)));
    this.crumbs.replaceChildren(...items);
  }

  show() {
    const wanted = this.filter.value.trim().toLowerCase();
    const seen = this.entries.filter((entry) => entry.name.toLowerCase().includes(wanted));
    this.body.replaceChildren(...seen.map((entry) => this.row(entry)));
    const movies = seen.filter((entry) => entry.kind === "movie").length;
    this.asOne.hidden = !this.path || movies < 2;
    const empty = wanted ? "Nothing here has this in its name." : "This folder is empty. Put a movie into it: DM4, TIFF, MRC, EMD, SER, TVIPS, SEQ, MIB, HDF5, Zarr, .npy, raw, or a folder of images.";
    this.note.replaceChildren(seen.length ? h("p", { class: "sr", "aria-live": "polite" }, `${several(seen.length, "entry", "entries")}, ${several(movies, "movie")}`) : h("p", { class: "empty" }, this.next ? "None of those that were read so far." : empty),
      this.next ? h("button", { type: "button", class: "button", onclick: (/** @type {Event & { currentTarget: HTMLButtonElement }} */ event) => this.more(event.currentTarget) }, `Show more than ${this.entries.length} entries`) : "");
  }

  /** @param {Entry} entry */
  row(entry) {
    const { kind } = entry;
    const choose = () => (kind === "folder" ? this.open(entry.path) : this.onMovie(entry.path));
    if (kind === "unusable") {
      return h("tr", { dataset: { kind } }, h("td", { class: "muted", title: "Its name is not UTF-8: rename it" }, icon("file"), h("span", {}, entry.name)), h("td", {}), h("td", {}));
    }
    const title = kind === "file" ? `${entry.name}: no movie by its name; you can try` : entry.name;
    return h("tr", { dataset: { kind } },
      h("td", {}, h("button", { type: "button", class: "entry", title, onclick: choose, dataset: { path: entry.path } }, icon(kind), h("span", {}, entry.name))),
      h("td", { class: "number muted" }, entry.bytes === null ? "" : bytes(entry.bytes)),
      h("td", { class: "number muted", title: fullTime(entry.modified) }, moment(entry.modified)));
  }
}

/** @param {keyof typeof ICONS} kind */
function icon(kind) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  for (const [name, value] of Object.entries({ viewBox: "0 0 20 20", width: "18", height: "18", role: "img", "aria-label": kind })) svg.setAttribute(name, value);
  const path = document.createElementNS(svg.namespaceURI, "path");
  for (const [name, value] of Object.entries({ d: ICONS[kind], fill: "none", stroke: "currentColor", "stroke-width": "1.3", "stroke-linejoin": "round" })) path.setAttribute(name, value);
  svg.append(path);
  return svg;
}
