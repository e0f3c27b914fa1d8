// The colours of the style sheet, for what is drawn on a canvas; theme.js chooses the theme.

/** `theme.onChange(draw)` for what does not follow the style sheet by itself; it returns a function that ends it. */
export const theme = {
  /** @param {() => void} handle */
  onChange(handle) {
    document.addEventListener("themechange", handle);
    return () => document.removeEventListener("themechange", handle);
  },
  /**
   * The value of a variable of the style sheet, such as `theme.color("--accent")`.
   * @param {string} name
   */
  color(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); },
};
