"use strict";
// Draws the figures of the page. Toggles show and hide traces in all figures; pointing at a tick of a run marks the same
// tick in the linked figure.
const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
const DASHES = { solid: "", dash: "6 3", dashdot: "6 2 2 2", dot: "2 2", longdash: "10 3", longdashdot: "10 2 2 2" };
const visibleValues = Object.fromEntries(content.toggles.map((toggle) => [toggle.name, new Set(toggle.shown)]));
const isVisible = (trace) => Object.entries(trace.meta.labels).every(([name, value]) => !(name in visibleValues) || visibleValues[name].has(value));
const plots = [];

function draw(figure, place) {
  plots.push(place);
  const data = figure.data.map((trace) => ({ ...trace, visible: isVisible(trace) }));
  // A narrow plot has a legend entry per line, and a legend takes at most half of the height.
  const rows = figure.layout.showlegend && place.clientWidth < 420 ? new Set(data.map((trace) => trace.name)).size : 0;
  return Plotly.newPlot(place, data, { ...figure.layout, height: Math.max(figure.layout.height, 42 * rows + 30) }, CONFIG);
}

const updateVisibility = () => plots.forEach((place) => Plotly.restyle(place, { visible: place.data.map(isVisible) }));

function swatch(index) {
  const sample = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const { colours, dashes } = content.look;
  const dash = DASHES[dashes[index % dashes.length]];
  sample.innerHTML = `<line x1="0" y1="6" x2="26" y2="6" stroke-width="2.5" stroke="${colours[index % colours.length]}" stroke-dasharray="${dash}"/>`;
  for (const [name, value] of [["width", 26], ["height", 12], ["aria-hidden", true]]) sample.setAttribute(name, value);
  return sample;
}

function toggleBox(toggle, value, index) {
  const box = element("input", { type: "checkbox", "data-toggle": toggle.name, "data-value": value });
  box.checked = visibleValues[toggle.name].has(value);
  box.addEventListener("change", () => {
    visibleValues[toggle.name][box.checked ? "add" : "delete"](value);
    updateVisibility();
  });
  return element("label", { class: "toggle" }, box, ...(toggle.styled ? [swatch(index)] : []), value);
}

function link(from, to) {
  from.on("plotly_hover", ({ points: [{ data, pointNumber }] }) => {
    const curveNumber = to.data.findIndex((trace) => trace.meta.group && trace.meta.group === data.meta.group);
    if (curveNumber >= 0) Plotly.Fx.hover(to, [{ curveNumber, pointNumber }], "xy", true);
  });
}

function card(title, body, note, kind = "") {
  return element("figure", { class: `card ${kind}` }, element("h3", {}, title), body, ...(note ? [element("p", { class: "note" }, note)] : []));
}

const plot = (attributes = {}) => element("div", { class: "plot", ...attributes });

async function writeViews() {
  byId("toggles")?.append(...content.toggles.map((toggle) =>
    element("fieldset", {}, element("legend", {}, toggle.name), ...toggle.values.map((value, i) => toggleBox(toggle, value, i)))));
  let charts = null;
  for (const view of content.views) {
    if (view.kind === "runs") {
      const [plane, times] = [plot({ id: "plane" }), plot({ id: "times" })];
      byId("views").append(element("div", { class: "linked" }, card("Path in the plane", plane, "", "where"), card("Over time", times, view.note)));
      await draw(view.plane, plane);
      await draw(view.times, times);
      link(plane, times);
      link(times, plane);
      charts = null;
      continue;
    }
    if (!charts) byId("views").append((charts = element("div", { class: "charts" })));
    const body = view.kind === "picture" ? element("img", { src: view.source, alt: view.title }) : plot();
    charts.append(card(view.title, body, view.note, view.broad ? "broad" : ""));
    await (view.kind === "picture" ? body.decode().catch(() => undefined) : draw(view.figure, body));
  }
}

for (const [kind, action] of [["beforeprint", "add"], ["afterprint", "remove"]]) {
  window.addEventListener(kind, () => {
    document.documentElement.classList[action]("printing");
    plots.forEach((place) => Plotly.Plots.resize(place));
  });
}
writeText();
writeViews().then(() => requestAnimationFrame(() => document.documentElement.setAttribute("data-ready", "")));
