// The parts of the report that answer: the map of columns, the chosen column in time, curves over the frames, dots.

import { lineChart } from "./charts.js";
import { ColumnMap } from "./column_map.js";
import { at, setText } from "./dom.js";
import { significant } from "./format.js";
import { drawColourBar, scaleOf } from "./number_colours.js";
import { scatterChart } from "./scatter_chart.js";
import { theme } from "./theme_colours.js";

/** @typedef {{ numbers: Int16Array, zero: Float64Array, step: Float64Array }} Packed */

const MISSING = -32768; // of 16 bit numbers
const FEW = 400; // points, up to which each is drawn
const CHOSEN = 2; // the colour of the chosen column, everywhere

const data = JSON.parse(at("data").textContent ?? "");
const { unit, time_unit: timeUnit, ids, kinds, shades } = data;
const columns = unpackAll(data.columns), frames = unpackAll(data.frames), time = unpack(data.series.time);
const inTime = { group: "series", formatX: (value) => `${significant(value, 6)} ${timeUnit}` };
let chosen = -1;
/** @type {ReturnType<typeof scaleOf>} */
let scale = null;

function unpack({ dtype, base64 }) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return dtype === "int16" ? new Int16Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

function unpackAll(packed) { return Object.fromEntries(Object.entries(packed).map(([name, one]) => [name, unpack(one)])); }

const series = Object.fromEntries(["x", "y", "intensity"].map((name) =>
  [name, Object.fromEntries(Object.entries(data.series[name]).map(([kind, one]) => [kind, /** @type {Packed} */ (unpackAll(one))]))]));

/**
 * The values of a column in time; NaN where no fit is accepted.
 * @param {Packed} packed
 * @param {number} column
 */
function valuesOf({ numbers, zero, step }, column) {
  const own = numbers.subarray(column * time.length, (column + 1) * time.length);
  return Float64Array.from(own, (number) => (number === MISSING ? NaN : zero[column] + step[column] * number));
}

// ---- the chosen column in time ----
const LABELS = { x: `x (${unit})`, y: `y (${unit})`, intensity: "intensity (counts)" };
const charts = Object.fromEntries(Object.keys(LABELS).map((name) => [name, lineChart(at(name), {
  ...inTime, height: name === "intensity" ? 186 : 170, levels: name === "intensity" ? [] : [0],
  xLabel: name === "intensity" ? `time (${timeUnit})` : "", series: [],
})]));

function seriesOf(name) {
  const values = Object.fromEntries(Object.entries(series[name]).map(([kind, one]) => [kind, valuesOf(one, chosen)]));
  const { mean, error, low, high } = values, own = { x: time, y: mean, color: CHOSEN, gaps: true };
  const line = {
    ...own, name: LABELS[name], kind: time.length <= FEW ? "dots" : "line",
    low: mean.map((value, index) => value - error[index]), high: mean.map((value, index) => value + error[index]),
  };
  return low ? [line, { ...own, name: "extremes", low, high, kind: "band" }] : [line];
}

// ---- all columns ----
const nameOf = (index) => `Column ${ids[index]}${kinds[index] ? ` ${kinds[index]}` : ""}`;
const textOf = ({ name, unit: own }, index) => `${significant(columns[name][index], 3)}${own ? ` ${own}` : ""}`;
const rows = ids.map((id, index) => ({ column_id: id, x: columns.x[index], y: columns.y[index], index }));

const map = new ColumnMap(at("map"), at("tip"), {
  onToggle: ({ index }) => choose(index),
  describe: ({ index, x, y }) => [nameOf(index), `x ${x.toFixed(2)}, y ${y.toFixed(2)} px`, ...shades.map((shade) => `${shade.label} ${textOf(shade, index)}`)],
});

const spread = columns.excess && scatterChart(at("spread"), {
  label: "Spread of each column against its stated error", x: columns.expected, y: columns.spread, xRange: [0, null], yRange: [0, null],
  xLabel: `stated error (${unit})`, yLabel: `spread (${unit})`, diagonal: true, onPick: choose, nameOf,
  tell: (index) => `stated error ${significant(columns.expected[index], 3)} ${unit}, spread ${significant(columns.spread[index], 3)} ${unit}`,
});
const share = columns.share && columns.r_squared && scatterChart(at("share"), {
  label: "R² of each column against its share of accepted fits", x: columns.share, y: columns.r_squared,
  xLabel: "accepted (%)", yLabel: "R²", onPick: choose, nameOf,
  tell: (index) => `accepted ${significant(columns.share[index], 3)} %, R² ${significant(columns.r_squared[index], 3)}`,
});
const scatters = [spread, share].filter(Boolean);

function colour() {
  const shade = shades.find(({ name }) => name === at("shade", HTMLSelectElement).value), found = shade ? scaleOf([...columns[shade.name]]) : null;
  scale = found;
  map.show({ colourOf: ({ index }) => (found && Number.isFinite(columns[shade.name][index]) ? found.colour(columns[shade.name][index]) : null) });
  drawBar();
}

function drawBar() {
  const shade = shades.find(({ name }) => name === at("shade", HTMLSelectElement).value);
  drawColourBar(at("colour-bar", HTMLCanvasElement), scale, shade ? `${shade.label}${shade.unit ? ` (${shade.unit})` : ""}` : "");
}

/** Show a column in time, and where it is among the others. */
function choose(index) {
  chosen = index;
  at("column", HTMLSelectElement).value = String(index);
  setText(at("chosen"), `${ids[index]}${kinds[index] ? ` (${kinds[index]})` : ""}`);
  setText(at("said"), shades.map((shade) => `${shade.label} ${textOf(shade, index)}`).join(" · "));
  for (const [name, chart] of Object.entries(charts)) chart.update({ label: `${name} of column ${ids[index]} in time`, empty: "No fit is accepted", series: seriesOf(name) });
  for (const chart of scatters) chart.update({ chosen: index });
  mark();
}

const mark = () => map.show({ chosen: new Map([[ids[chosen], theme.color(`--series-${CHOSEN}`)]]) });

// ---- all frames ----
const inFrames = { group: "frames", height: 200, formatX: inTime.formatX, xLabel: `time (${timeUnit})` };
const curve = (name, y, color, own) => ({ name, x: frames.time, y, color, unit: own, gaps: true });
const frameCharts = [
  lineChart(at("drift"), { ...inFrames, label: "Drift in time", yLabel: `drift (${unit})`, series: [curve("x", frames.x, 1, unit), curve("y", frames.y, 2, unit)] }),
  lineChart(at("accepted"), {
    ...inFrames, label: "Frames in time", yLabel: "%", yRange: [0, 103],
    series: [curve("accepted fits", frames.share, 1, "%"), ...(frames.quality ? [curve("correlation with the sum", frames.quality, 2, "%")] : [])],
  }),
];

async function showImage() {
  const picture = at("summed", HTMLImageElement), { width, height, covered, pixel_size_pm: pixelSizePm } = data.image;
  await picture.decode();
  const bitmap = await createImageBitmap(picture);
  picture.remove();
  map.show({ rows });
  map.setImage({ width, height, pixelSizePm, picture: { bitmap, width: covered[0], height: covered[1] } });
}

function listen() {
  const step = (by) => choose((chosen + by + ids.length) % ids.length);
  const column = at("column", HTMLSelectElement);
  column.addEventListener("change", () => choose(Number(column.value)));
  at("before").addEventListener("click", () => step(-1));
  at("after").addEventListener("click", () => step(1));
  at("shade").addEventListener("change", colour);
  for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".go"))) {
    button.addEventListener("click", () => {
      choose(Number(button.dataset.place));
      at("look").scrollIntoView({ behavior: "smooth" });
    });
  }
  addEventListener("resize", drawBar);
  theme.onChange(() => { drawBar(); mark(); });
  const { dataset } = document.documentElement, before = { theme: dataset.theme };
  addEventListener("beforeprint", () => { // on white paper, and at once
    before.theme = dataset.theme;
    dataset.theme = "light";
    for (const one of [...Object.values(charts), ...scatters, ...frameCharts]) one.paint();
    drawBar();
  });
  addEventListener("afterprint", () => {
    dataset.theme = before.theme;
    document.dispatchEvent(new Event("themechange"));
  });
}

map.show({ rows });
listen();
colour();
if (ids.length) choose(data.first);
showImage();
