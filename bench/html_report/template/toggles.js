"use strict";
// Toggles that act on all views at once: a run or series is shown where all its labels are.
const shown = Object.fromEntries(content.toggles.map((toggle) => [toggle.name, new Set(toggle.shown)]));
const isShown = (labels) => Object.entries(labels).every(([name, value]) => !(name in shown) || shown[name].has(value));
const redraws = [];

const DASHES = { solid: "", dash: "6 3", dashdot: "6 2 2 2", dot: "2 2", longdash: "10 3", longdashdot: "10 2 2 2" };
const style = (index) => ({
  colour: content.look.colours[index % content.look.colours.length],
  dash: content.look.dashes[index % content.look.dashes.length],
  // There are as many markers as colours: in the second round each goes with the next.
  marker: content.look.markers[(index + Math.floor(index / content.look.colours.length)) % content.look.markers.length],
});

function svg(tag, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function swatch(colour, dash, width = 2.5) {
  const drawn = svg("svg", { width: 26, height: 12, "aria-hidden": "true" });
  drawn.append(svg("line", { x1: 0, y1: 6, x2: 26, y2: 6, stroke: colour, "stroke-width": width, "stroke-dasharray": DASHES[dash] }));
  return drawn;
}

function toggleBox(name, value, checked, mark, onChange) {
  const box = element("input", { type: "checkbox", "data-toggle": name, "data-value": value });
  box.checked = checked;
  box.addEventListener("change", () => onChange(box.checked));
  return element("label", { class: "toggle" }, box, ...(mark ? [mark] : []), value);
}

function toggleGroup(toggle) {
  const boxes = toggle.values.map((value, i) => {
    const look = style(i);
    const mark = toggle.styled ? swatch(look.colour, look.dash) : null;
    return toggleBox(toggle.name, value, shown[toggle.name].has(value), mark, (on) => {
      shown[toggle.name][on ? "add" : "delete"](value);
      redraws.forEach((redraw) => redraw());
    });
  });
  return element("fieldset", {}, element("legend", {}, toggle.name), ...boxes);
}

function writeToggles() {
  byId("toggles")?.append(...content.toggles.map(toggleGroup));
}
