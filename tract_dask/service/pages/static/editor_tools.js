// What the pointer does, by tool. A gesture is {move(point, event), end(point, event), cancel()}; see image_view.js.

import { several } from "./format.js";
import { ringRadius } from "./editor_paint.js";

/**
 * @import { Editor } from "./editor.js"
 * @import { Gesture, Point, Pointed } from "./image_view.js"
 */

const CLICK_PX = 4; // a pointer that moved less has clicked

export const TOOLS = {
  select: {
    name: "Select and move", key: "v",
    hint: "Click a column to select it, Shift-click for more · drag it to move it · drag around columns to select them · Space-drag moves the view",
  },
  lasso: {
    name: "Lasso", key: "l",
    hint: "Draw around columns to select them · Shift adds, Alt takes away · Delete removes what is selected",
  },
  erase: {
    name: "Lasso and delete", key: "d",
    hint: "Draw around columns to delete them at once, or click one · Ctrl+Z brings them back",
  },
  add: {
    name: "Add", key: "a",
    hint: "Click where a column should be: it moves to the maximum nearby · drag moves the view · Alt-click puts it exactly there",
  },
  lattice: {
    name: "Lattice", key: "t",
    hint: "Click the origin, then an atom along a, then one along b: the farther away, the more precise",
  },
};

/**
 * The gesture that begins where the pointer is down; null: the view moves.
 * @param {Editor} editor
 * @param {Pointed} point
 * @param {PointerEvent} event
 * @returns {Gesture | null}
 */
export function beginGesture(editor, point, event) {
  if (editor.spaceDown) return null;
  return { select: selecting, lasso: lassoing, erase: erasing, add: adding, lattice: latticing }[editor.tool](editor, point, event);
}

/**
 * The column under the pointer.
 * @param {Editor} editor
 * @param {Point} point
 */
export function hit(editor, { x, y }) {
  const { model, view } = editor;
  return model.grid.nearest(x, y, (Math.max(6, ringRadius(view, model.spacing)) + 4) / view.scale);
}

const far = (one, other) => Math.hypot(one.sx - other.sx, one.sy - other.sy) > CLICK_PX;
const how = (event) => (event.altKey ? "subtract" : event.shiftKey || event.ctrlKey || event.metaKey ? "add" : "replace");

function selecting(editor, start, event) {
  const column = hit(editor, start);
  if (!column) return boxing(editor, start);
  const several = event.shiftKey || event.ctrlKey || event.metaKey;
  const { model } = editor;
  const wasSelected = model.selection.has(column.id);
  if (!wasSelected) model.select([column.id], several ? "add" : "replace");
  let moved = false;
  return {
    move(point) {
      if (!moved && !far(start, point)) return;
      moved = true;
      editor.moving = { ids: new Set(model.selection), dx: point.x - start.x, dy: point.y - start.y };
      editor.redraw();
    },
    end(point, up) {
      editor.moving = null;
      if (moved) editor.moveSelected(point.x - start.x, point.y - start.y, up.altKey);
      else if (wasSelected) model.select([column.id], several ? "toggle" : "replace");
    },
    cancel() {
      editor.moving = null;
      editor.redraw();
    },
  };
}

function boxing(editor, start) {
  const box = (point) => [start, { x: point.x, y: start.y }, point, { x: start.x, y: point.y }];
  return outlining(editor, start, (point) => box(point), (line, event, clicked) => {
    if (clicked) {
      if (how(event) === "replace") editor.model.select([]);
      return;
    }
    const [[x0, x1], [y0, y1]] = [[line[0].x, line[2].x], [line[0].y, line[2].y]].map((ends) => ends.sort((a, b) => a - b));
    editor.model.select(editor.model.grid.inBox(x0, y0, x1, y1).map(({ id }) => id), how(event));
  });
}

function lassoing(editor, start) {
  return outlining(editor, start, free(start), (line, event, clicked) => {
    const found = clicked ? [hit(editor, start)].filter(Boolean) : editor.model.grid.inside(line);
    editor.model.select(found.map(({ id }) => id), how(event));
  });
}

function erasing(editor, start) {
  editor.danger = true;
  return outlining(editor, start, free(start), (line, event, clicked) => {
    const found = clicked ? [hit(editor, start)].filter(Boolean) : editor.model.grid.inside(line);
    editor.remove(found.map(({ id }) => id));
  });
}

/** A line that follows the pointer. */
function free(start) {
  const line = [start];
  return (point) => {
    if (far(line.at(-1), point)) line.push(point);
    return line;
  };
}

function outlining(editor, start, shape, finish) {
  let clicked = true;
  const clear = () => {
    editor.outline = null;
    editor.danger = false;
    editor.redraw();
  };
  return {
    move(point) {
      clicked &&= !far(start, point);
      if (clicked) return;
      editor.outline = shape(point);
      editor.redraw();
    },
    end(point, event) {
      const line = shape(point);
      clear();
      finish(line, event, clicked);
    },
    cancel: clear,
  };
}

function adding(editor, start, event) {
  const column = hit(editor, start);
  if (column) return selecting(editor, start, event);
  return panningUnlessClicked(editor, start, (point, up) => editor.add(point, up.altKey));
}

function latticing(editor, start) {
  const handle = editor.lattice.handleAt(start);
  if (handle === null) {
    return panningUnlessClicked(editor, start, (point, up) => editor.lattice.click(point, up.altKey));
  }
  const before = editor.lattice.handles[handle];
  return {
    move: (point) => editor.lattice.drag(handle, { x: before.x + point.x - start.x, y: before.y + point.y - start.y }),
    end: (point, up) => far(start, point) && editor.lattice.drop(handle, up.altKey),
    cancel: () => editor.lattice.drag(handle, before),
  };
}

/** A drag moves the view; a click does something. */
function panningUnlessClicked(editor, start, click) {
  let last = start;
  let moved = false;
  return {
    move(point) {
      if (!moved && !far(start, point)) return;
      moved = true;
      editor.view.pan(point.sx - last.sx, point.sy - last.sy);
      last = point;
    },
    end(point, event) {
      if (!moved) click(start, event);
    },
  };
}

/** "Delete 3 columns" and the like, for the history. */
export const step = (verb, number) => `${verb} ${several(number, "column")}`;
