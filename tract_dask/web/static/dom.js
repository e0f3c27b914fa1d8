// Elements in one call, and the two questions that pages ask: "are you sure?" and nothing else.

/**
 * Make an element. Properties are attributes, except `class`, `dataset`, `style` (an object) and `on…` (listeners);
 * `false`, `null` and `undefined` leave an attribute out. Children are nodes or text, never HTML.
 * @example h("button", { class: "button", onclick: save }, "Save")
 */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name === "value") element.value = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Set text only where it differs, so that nothing flickers and no screen reader repeats itself. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set, or with null remove, an attribute only where it differs. */
export function setAttribute(element, name, value) {
  if (value === null || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
}

/**
 * Ask before something that cannot be undone. Resolves to null where the user steps back, else to
 * `{ checked }`, the state of the optional check box.
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
