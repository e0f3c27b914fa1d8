// Elements: made in one call, found, and changed; and the question "are you sure?".

/** @typedef {Node | string | false | null | undefined} Child */

/**
 * Make an element. Properties are attributes, except `class`, `dataset`, `style` (an object) and `on…` (listeners);
 * `false`, `null` and `undefined` leave an attribute out. Children are nodes or text, never HTML.
 * @example h("button", { class: "button", onclick: save }, "Save")
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Record<string, any>} properties
 * @param {(Child | Child[])[]} children
 */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name === "value" && "value" in element) element.value = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat()) if (child !== null && child !== undefined && child !== false) element.append(child);
  return element;
}

/**
 * The element of this page with an id.
 * @template {HTMLElement} [T=HTMLElement]
 * @param {string} id
 * @param {new () => T} [kind] such as HTMLInputElement, where more is used of it than all elements have
 */
export const at = (id, kind) => checked(document.getElementById(id), `#${id}`, kind);

/**
 * The first element that a selector finds in `within`.
 * @template {HTMLElement} [T=HTMLElement]
 * @param {string} selector
 * @param {new () => T} [kind] as of `at`
 * @param {ParentNode} within
 */
export const find = (selector, kind, within = document) => checked(within.querySelector(selector), selector, kind);

/**
 * @template {HTMLElement} [T=HTMLElement]
 * @param {Element | null} element
 * @param {string} name
 * @param {new () => T} kind
 * @returns {T}
 */
function checked(element, name, kind = /** @type {any} */ (HTMLElement)) {
  if (!(element instanceof kind)) throw new Error(`This page has no ${kind.name} ${name}`);
  return element;
}

/**
 * What draws on a canvas.
 * @param {HTMLCanvasElement} canvas
 */
export const penOf = (canvas) => /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));

/**
 * Set text only where it differs, so that nothing flickers and no screen reader repeats itself.
 * @param {Node} element
 * @param {string} text
 */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/**
 * Set, or with null remove, an attribute only where it differs.
 * @param {Element} element
 * @param {string} name
 * @param {string | number | false | null} value
 */
export function setAttribute(element, name, value) {
  if (value === null || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, String(value));
}

/**
 * Ask before something that cannot be undone. Resolves to null where the user steps back, else to
 * `{ checked }`, the state of the optional check box.
 * @param {{ title: string, text: string, action: string, danger?: boolean, checkbox?: string }} question
 * @returns {Promise<{ checked: boolean } | null>}
 */
export function ask({ title, text, action, danger = false, checkbox = "" }) {
  return new Promise((resolve) => {
    const box = checkbox ? h("input", { type: "checkbox", name: "extra" }) : null;
    const dialog = h("dialog", { class: "dialog", "aria-labelledby": "ask-title" },
      h("form", { method: "dialog" },
        h("h2", { id: "ask-title" }, title),
        h("p", {}, text),
        box && h("label", { class: "check" }, box, checkbox),
        h("div", { class: "dialog-actions" },
          h("button", { class: "button", value: "no" }, "Keep as it is"),
          h("button", { class: `button ${danger ? "danger" : "primary"}`, value: "yes" }, action))));
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes" ? { checked: Boolean(box?.checked) } : null);
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}
