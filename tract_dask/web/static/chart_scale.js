// Axes of charts: pure functions, numbers in, numbers and text out.

/**
 * @typedef {[number, number]} Range
 * @typedef {[number | null, number | null]} Edges of a range; null is fitted to the data
 * @typedef {ArrayLike<number | null> & Iterable<number | null>} Gappy numbers; null and NaN are gaps
 */

/**
 * Round values that divide [low, high] into about `wanted` steps (at most a third more) of 1, 2 or 5 times a power of ten.
 * @param {number} low
 * @param {number} high
 * @param {number} wanted
 */
export function ticks(low, high, wanted) {
  const rough = (high - low) / Math.max(wanted, 1);
  if (!(rough > 0) || !Number.isFinite(rough)) return { values: [low], step: 1 };
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((factor) => factor * power >= rough * 0.75) ?? 10);
  /** @type {number[]} */
  const values = [];
  for (let index = Math.ceil(low / step - 1e-9); index * step <= high + step * 1e-9; index += 1) values.push(index * step);
  return { values, step };
}

/**
 * A tick's text, with as many decimals as its step asks for: 0.25, 1,200, 2M.
 * @param {number} value
 * @param {number} step
 */
export function tickText(value, step) {
  if (Math.abs(value) < step * 1e-6) return "0";
  const size = Math.max(Math.abs(value), step);
  if (size >= 1e15 || step < 1e-6) return value.toPrecision(3);
  const [scale, letter] = /** @type {[number, string]} */ (size >= 1e6 ? [1e6, "M"] : size >= 1e4 ? [1e3, "k"] : [1, ""]);
  const decimals = Math.max(0, -Math.floor(Math.log10(step / scale) + 1e-9));
  return (value / scale).toFixed(Math.min(decimals, 6)) + letter;
}

/**
 * The least and greatest of the numbers in `values`, merged into `range`; gaps (null, NaN) are passed over.
 * @param {Range} range
 * @param {Iterable<number | null>} values
 */
export function extend(range, values) {
  for (const value of values) {
    if (value === null || !Number.isFinite(value)) continue;
    if (value < range[0]) range[0] = value;
    if (value > range[1]) range[1] = value;
  }
  return range;
}

/**
 * A range that can be drawn: of some width, with room around.
 * @param {Range} range
 * @returns {Range}
 */
export function padded([low, high], share = 0.06) {
  if (!(low <= high)) return [0, 1];
  const width = high - low || Math.abs(high) * 0.2 || 1;
  return [low - width * share, high + width * share];
}

/**
 * The index of the value in ascending `values` that is nearest to `wanted`; -1 where there is none.
 * @param {ArrayLike<number>} values
 * @param {number} wanted
 */
export function nearest(values, wanted) {
  const after = firstNotBelow(values, wanted);
  if (after === 0) return values.length ? 0 : -1;
  if (after === values.length) return after - 1;
  return wanted - values[after - 1] <= values[after] - wanted ? after - 1 : after;
}

/**
 * The first index of ascending `values` whose value is not below `wanted`.
 * @param {ArrayLike<number>} values
 * @param {number} wanted
 */
export function firstNotBelow(values, wanted) {
  let low = 0, high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] < wanted) low = middle + 1; else high = middle;
  }
  return low;
}
