// What is drawn over the image: columns, their refined positions, and the shapes of the tools. All in CSS px.

import { penOf } from "./dom.js";

/**
 * @import { Column, Model } from "./editor_model.js"
 * @import { Sites } from "./editor_lattice.js"
 * @import { ImageView, Point } from "./image_view.js"
 * @typedef {{ ids: Set<number>, dx: number, dy: number }} Moving columns, and how far they are dragged
 * @typedef {{ of: Column, x: number, y: number, flags: string[], with?: undefined }} Fitted where the fit of a column is
 * @typedef {{ of: Column, with: number, x?: undefined, y?: undefined, flags?: undefined }} Merged with the column that it fell together with
 * @typedef {Map<number, Fitted | Merged>} RefinedColumns
 * @typedef {object} Scene
 * @property {Model} model
 * @property {Map<string, string>} colours
 * @property {Moving | null} moving
 * @property {Column | null} hovered
 * @property {RefinedColumns | null} refined
 * @property {boolean} numbers
 * @property {number | null} pixelSizePm
 * @typedef {{ colour: string, whole: number[], broken: number[] }} Group places of whole and of broken rings, as x, y, x, y ...
 * @typedef {CanvasRenderingContext2D} Pen
 */

// Bright on grey, told apart by those who see fewer colours (after Okabe and Ito); the first is for columns without a kind.
const KINDS = ["#4fc3ff", "#ffb000", "#5ee08a", "#ff7fb6", "#f4e84a", "#b69bff", "#ff8a5c", "#c4f0ff"];
const SHADE = "rgb(0 0 0 / 60%)";
const SELECTED = "#ffffff";
const WARNING = "#ff5340";
const REFINED = "#ffffff";
const DENSE = 3.2; // radius in px, below which columns are dots
const LABELS_FROM = 46; // px between columns, from which on there is room for numbers
const MOST_LABELS = 600;

/** What the fit of a column says against it; a shape at its bound alone does not. */
export const FLAGS = {
  outside_frame: "window leaves the image",
  below_noise: "below the noise",
  not_converged: "fit did not converge",
  at_bound: "fit at a bound",
  bad_frame: "bad frame",
};

/**
 * The colour of each kind, in the order in which they came up.
 * @param {Iterable<string>} kinds
 */
export function kindColours(kinds) {
  const named = [...kinds].filter((kind) => kind !== "");
  const colours = new Map(named.map((kind, index) => [kind, KINDS[1 + (index % (KINDS.length - 1))]]));
  return colours.set("", KINDS[0]);
}

/** Whether a column is drawn broken: it is kept where it is and not fitted. */
const isUnfitted = (flags) => flags.includes("outside_frame");
const isDoubtful = (flags) => flags.some((flag) => flag in FLAGS && flag !== "outside_frame");

/**
 * The radius of a column's ring, px.
 * @param {ImageView} view
 * @param {number | null} spacing
 */
export function ringRadius(view, spacing) {
  return Math.min(13, Math.max(2.5, 0.17 * (spacing ?? 40) * view.scale));
}

/**
 * Draw the columns that can be seen.
 * @param {Pen} pen
 * @param {ImageView} view
 * @param {Scene} scene
 */
export function paintColumns(pen, view, scene) {
  const { model, colours, moving, hovered } = scene;
  const radius = ringRadius(view, model.spacing);
  const { x0, y0, x1, y1 } = view.visible();
  const beyond = (radius + 4) / view.scale;
  /** @type {Map<string, Group>} */
  const groups = new Map(); // by kind
  const selected = /** @type {number[]} */ ([]), doubtful = /** @type {number[]} */ ([]);
  const labelled = /** @type {[Column, number, number][]} */ ([]);
  let kind = "", group = /** @type {Group | null} */ (null);
  const { scale, size, middle } = view;
  const place = (/** @type {Column} */ column, dx = 0, dy = 0) => {
    const x = (column.x + dx - middle.x) * scale + size.width / 2; // as view.toScreen, for very many
    const y = (column.y + dy - middle.y) * scale + size.height / 2;
    if (column.kind !== kind || !group) {
      kind = column.kind;
      group = groups.get(kind) ?? { colour: colours.get(kind) ?? KINDS[0], whole: [], broken: [] };
      groups.set(kind, group);
    }
    const flagged = column.flags.length > 0;
    (flagged && isUnfitted(column.flags) ? group.broken : group.whole).push(x, y);
    if (model.selection.has(column.id)) selected.push(x, y);
    if (flagged && isDoubtful(column.flags)) doubtful.push(x, y);
    if (labelled.length <= MOST_LABELS) labelled.push([column, x, y]);
  };
  model.grid.visit(x0 - beyond, y0 - beyond, x1 + beyond, y1 + beyond, (column) => {
    if (!moving?.ids.has(column.id)) place(column);
  });
  for (const id of moving?.ids ?? []) {
    const column = model.columns.get(id);
    if (column && moving) place(column, moving.dx, moving.dy);
  }

  pen.save();
  if (radius < DENSE) {
    const all = [...groups.values()].flatMap(({ colour, whole, broken }) => /** @type {[number[], string][]} */ ([[whole, colour], [broken, colour]]));
    dots(pen, view, [...all, [doubtful, WARNING]]);
  } else {
    for (const { colour, whole, broken } of groups.values()) {
      rings(pen, whole, radius, colour, false);
      rings(pen, broken, radius, colour, true);
    }
    badges(pen, doubtful, radius);
  }
  marked(pen, selected, radius);
  if (hovered && model.columns.get(hovered.id) === hovered && !moving) {
    const at = view.toScreen(hovered.x, hovered.y);
    rings(pen, [at.x, at.y], radius + 3, SELECTED, false, 1.25);
  }
  const roomy = (model.spacing ?? 60) * view.scale >= LABELS_FROM && labelled.length <= MOST_LABELS;
  if (scene.refined) paintRefined(pen, view, scene, labelled.map(([column]) => column), radius, roomy);
  if (scene.numbers && roomy) {
    for (const [column, x, y] of labelled) label(pen, String(column.id), x + 0.75 * radius + 3, y - 0.75 * radius - 3);
  }
  pen.restore();
}

/**
 * @param {Pen} pen
 * @param {number[]} places
 * @param {number} radius
 * @param {string} colour
 * @param {boolean} broken
 */
function rings(pen, places, radius, colour, broken, width = 2) {
  if (!places.length) return;
  circles(pen, places, radius);
  pen.setLineDash([]);
  pen.strokeStyle = SHADE;
  pen.lineWidth = width + 2;
  pen.stroke();
  pen.setLineDash(broken ? [4, 3] : []);
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
  pen.setLineDash([]);
}

/**
 * The path of a circle around each place, x, y, x, y ...
 * @param {Pen} pen
 * @param {number[]} places
 * @param {number} radius
 */
function circles(pen, places, radius) {
  pen.beginPath();
  for (let n = 0; n < places.length; n += 2) {
    pen.moveTo(places[n] + radius, places[n + 1]);
    pen.arc(places[n], places[n + 1], radius, 0, 2 * Math.PI);
  }
}

let kept = /** @type {{ dotted: HTMLCanvasElement, layer: ImageData } | null} */ (null); // from one drawing to the next

/**
 * Squares of a few pixels, written straight into an image: there may be very many.
 * @param {Pen} pen
 * @param {ImageView} view
 * @param {[places: number[], colour: string][]} groups
 */
function dots(pen, view, groups) {
  const { ratio } = view;
  const [width, height] = [pen.canvas.width, pen.canvas.height];
  if (kept?.dotted.width !== width || kept.dotted.height !== height) {
    kept = { dotted: Object.assign(document.createElement("canvas"), { width, height }), layer: new ImageData(width, height) };
  }
  const { dotted, layer } = kept;
  const pixels = new Uint32Array(layer.data.buffer).fill(0);
  const square = (x, y, half, colour) => {
    const left = Math.max(0, Math.round((x - half) * ratio));
    const right = Math.min(width, Math.round((x + half) * ratio));
    const bottom = Math.min(height, Math.round((y + half) * ratio));
    for (let row = Math.max(0, Math.round((y - half) * ratio)); row < bottom; row++) {
      for (let n = row * width + left; n < row * width + right; n++) pixels[n] = colour;
    }
  };
  for (const [places, colour] of groups) {
    const rgba = parseInt(`ff${colour.slice(5, 7)}${colour.slice(3, 5)}${colour.slice(1, 3)}`, 16); // as it lies in memory
    for (let n = 0; n < places.length; n += 2) square(places[n], places[n + 1], 2.5, 0x99000000);
    for (let n = 0; n < places.length; n += 2) square(places[n], places[n + 1], 1.5, rgba);
  }
  penOf(dotted).putImageData(layer, 0, 0);
  pen.drawImage(dotted, 0, 0, width / ratio, height / ratio);
}

/**
 * @param {Pen} pen
 * @param {number[]} places
 * @param {number} radius
 */
function badges(pen, places, radius) {
  for (let n = 0; n < places.length; n += 2) {
    pen.beginPath();
    pen.arc(places[n] + 0.71 * radius, places[n + 1] - 0.71 * radius, 4, 0, 2 * Math.PI);
    pen.fillStyle = WARNING;
    pen.fill();
    pen.lineWidth = 1.25;
    pen.strokeStyle = "#fff";
    pen.stroke();
  }
}

/**
 * @param {Pen} pen
 * @param {number[]} places
 * @param {number} radius
 */
function marked(pen, places, radius) {
  if (!places.length) return;
  circles(pen, places, Math.max(radius + 4, 4.5));
  pen.strokeStyle = "rgb(0 0 0 / 75%)";
  pen.lineWidth = 6;
  pen.stroke();
  pen.strokeStyle = SELECTED;
  pen.lineWidth = 3;
  pen.stroke();
}

/** Crosses where the fits are, with lines from where the columns were put, and how far that is. */
function paintRefined(pen, view, { model, refined, pixelSizePm }, columns, radius, roomy) {
  const arm = Math.min(7, Math.max(2.5, 0.55 * radius));
  const crosses = new Path2D();
  const lines = new Path2D();
  const lost = new Path2D();
  for (const column of columns) {
    const found = refined.get(column.id);
    if (!found || found.of !== column) continue;
    const [from, to] = [view.toScreen(column.x, column.y), view.toScreen(found.x, found.y)];
    if (found.with !== undefined) {
      lost.moveTo(from.x - arm, from.y - arm);
      lost.lineTo(from.x + arm, from.y + arm);
      lost.moveTo(from.x + arm, from.y - arm);
      lost.lineTo(from.x - arm, from.y + arm);
      continue;
    }
    if (isUnfitted(found.flags)) continue;
    crosses.moveTo(to.x - arm, to.y);
    crosses.lineTo(to.x + arm, to.y);
    crosses.moveTo(to.x, to.y - arm);
    crosses.lineTo(to.x, to.y + arm);
    if (Math.hypot(to.x - from.x, to.y - from.y) > 1.5) {
      lines.moveTo(from.x, from.y);
      lines.lineTo(to.x, to.y);
    }
    if (roomy) label(pen, shiftText(column, found, pixelSizePm), from.x, from.y + radius + 14, "center");
  }
  for (const [path, colour] of /** @type {[Path2D, string][]} */ ([[lines, REFINED], [crosses, REFINED], [lost, WARNING]])) {
    pen.strokeStyle = SHADE;
    pen.lineWidth = 3.5;
    pen.stroke(path);
    pen.strokeStyle = colour;
    pen.lineWidth = 1.5;
    pen.stroke(path);
  }
}

/**
 * Whether a column has a fit of its own.
 * @param {Fitted | Merged} found
 * @returns {found is Fitted}
 */
export const isFitted = (found) => found.with === undefined;

/**
 * How far the fit is from where the column was put: pm, or px where a pixel's size is not known.
 * @param {Column} column
 * @param {Fitted} found
 * @param {number | null} pixelSizePm
 */
export function shiftText(column, found, pixelSizePm) {
  const shift = Math.hypot(found.x - column.x, found.y - column.y);
  return pixelSizePm ? `${(shift * pixelSizePm).toFixed(shift * pixelSizePm < 10 ? 1 : 0)} pm` : `${shift.toFixed(2)} px`;
}

/**
 * @param {Pen} pen
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {CanvasTextAlign} align
 */
export function label(pen, text, x, y, align = "left") {
  pen.font = "600 11px system-ui, sans-serif";
  pen.textAlign = align;
  pen.lineJoin = "round";
  pen.lineWidth = 3;
  pen.strokeStyle = "rgb(0 0 0 / 75%)";
  pen.strokeText(text, x, y);
  pen.fillStyle = "#fff";
  pen.fillText(text, x, y);
}

/**
 * A closed line or a box that is being drawn, [{x, y}] in image coordinates.
 * @param {Pen} pen
 * @param {ImageView} view
 * @param {Point[]} line
 * @param {boolean} danger
 */
export function paintOutline(pen, view, line, danger) {
  if (line.length < 2) return;
  pen.save();
  pen.beginPath();
  line.forEach(({ x, y }, index) => {
    const at = view.toScreen(x, y);
    if (index) pen.lineTo(at.x, at.y);
    else pen.moveTo(at.x, at.y);
  });
  pen.closePath();
  pen.fillStyle = danger ? "rgb(255 83 64 / 20%)" : "rgb(255 255 255 / 14%)";
  pen.fill();
  pen.strokeStyle = SHADE;
  pen.lineWidth = 3.5;
  pen.stroke();
  pen.setLineDash([5, 4]);
  pen.strokeStyle = danger ? WARNING : SELECTED;
  pen.lineWidth = 1.75;
  pen.stroke();
  pen.restore();
}

/**
 * The sites of a lattice that is being laid, its three atoms, and the steps between them.
 * @param {Pen} pen
 * @param {ImageView} view
 * @param {{ sites: Sites | null, handles: Point[], steps: Record<string, number> | null, colour: string }} lattice
 */
export function paintLattice(pen, view, { sites, handles, steps, colour }) {
  pen.save();
  const { x0, y0, x1, y1 } = view.visible();
  const paths = { new: new Path2D(), known: new Path2D() };
  const half = Math.min(7, Math.max(2, 0.1 * (sites?.spacing ?? 40) * view.scale));
  for (const site of sites?.places ?? []) {
    if (site.x < x0 || site.x > x1 || site.y < y0 || site.y > y1) continue;
    const at = view.toScreen(site.x, site.y);
    const path = site.known ? paths.known : paths.new;
    path.moveTo(at.x, at.y - half);
    path.lineTo(at.x + half, at.y);
    path.lineTo(at.x, at.y + half);
    path.lineTo(at.x - half, at.y);
    path.closePath();
  }
  for (const [path, stroke] of /** @type {[Path2D, string][]} */ ([[paths.known, "#9aa4ad"], [paths.new, colour]])) {
    pen.lineWidth = 3.5;
    pen.strokeStyle = SHADE;
    pen.stroke(path);
    pen.lineWidth = 1.75;
    pen.strokeStyle = stroke;
    pen.stroke(path);
  }
  const places = handles.map(({ x, y }) => view.toScreen(x, y));
  for (const [index, name] of /** @type {[number, string][]} */ ([[1, "a"], [2, "b"]])) {
    if (!places[index]) continue;
    pen.beginPath();
    pen.moveTo(places[0].x, places[0].y);
    pen.lineTo(places[index].x, places[index].y);
    for (const [stroke, width] of /** @type {[string, number][]} */ ([[SHADE, 4], ["#fff", 1.75]])) {
      pen.strokeStyle = stroke;
      pen.lineWidth = width;
      pen.stroke();
    }
    const count = steps?.[name];
    for (let step = 1; count && step < count; step++) {
      const share = step / count;
      pen.fillStyle = "#fff";
      pen.fillRect(places[0].x + share * (places[index].x - places[0].x) - 2, places[0].y + share * (places[index].y - places[0].y) - 2, 4, 4);
    }
  }
  places.forEach(({ x, y }, index) => {
    pen.beginPath();
    pen.arc(x, y, 9, 0, 2 * Math.PI);
    pen.fillStyle = "#fff";
    pen.fill();
    pen.lineWidth = 2;
    pen.strokeStyle = "rgb(0 0 0 / 80%)";
    pen.stroke();
    pen.fillStyle = "#000";
    pen.font = "700 12px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText("0ab"[index], x, y + 0.5);
    pen.textBaseline = "alphabetic";
  });
  pen.restore();
}
