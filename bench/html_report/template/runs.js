"use strict";
// Linked views of closed-loop runs: the path in the plane beside plots over time, one cursor in both, and a readout.
const GREY = "#7f7f7f";
const MOST_NAMED = 12;
const SVG_MARGIN = { l: 52, r: 40, t: 8, b: 40 };

// How strongly a way or mode is drawn: thick where the controller had more trouble, so that colour is not needed.
const STRIP = {
  unlimited: ["no limit active", "#56b4e9", 4],
  active_set: ["active set", "#0072b2", 8],
  osqp: ["OSQP", "#e69f00", 12],
  daqp: ["DAQP", "#e69f00", 12],
  none: ["nothing solved", "#7f7f7f", 2],
  FINISHED: ["finished", "#7f7f7f", 2],
  REUSED_PLAN: ["plan reused", "#cc79a7", 16],
  BRAKING: ["braking", "#d55e00", 16],
  STOPPED: ["stopped", "#000000", 16],
};
const stripOf = (what) => STRIP[what] || [what, "#000000", 6];

const decoded = (column) => column.v.map((value) => (value === null ? null : value * column.s));
const unpacked = (run) => ({ ...run, ...Object.fromEntries(Object.entries(run.columns).map(([name, column]) => [name, decoded(column)])) });

// What each pane draws: columns, each with its layer; titles for one run and for several.
const PANES = [
  { title: ["error [mm]: lateral, along dashed", "lateral error [mm], along dotted"], size: 1.25, lines: [["lateral", "error"], ["along", "along"]] },
  { title: ["heading error [mrad]", "heading error [mrad]"], size: 0.9, lines: [["heading", "error"]] },
  { title: ["v [m/s]: command, true dashed", "command v [m/s]"], size: 1.15, lines: [["reference_v", "reference"], ["v", "command"], ["true_v", "twist"]], limit: "limit_v" },
  { title: ["omega [rad/s]: command, true dashed", "command omega [rad/s]"], size: 1.15, lines: [["reference_omega", "reference"], ["omega", "command"], ["true_omega", "twist"]], limit: "limit_omega" },
  { title: ["step time [ms]", "step time [ms]"], size: 0.8, lines: [["step", "command"]] },
];
// Layers that can be shown and hidden; `several`: whether they are there at first where several runs are compared.
const LAYERS = {
  reference: { name: "reference", several: true, look: [GREY, "dot"] },
  along: { name: "along error", several: false, look: ["#d55e00", "dash"] },
  twist: { name: "true v, omega", several: false, look: ["#d55e00", "dash"] },
  estimate: { name: "estimate", several: false, look: ["#009e73", "dash"] },
  poses: { name: "poses that arrived", several: false, look: ["#cc79a7", "dot"] },
  limits: { name: "limits", several: false, look: ["#000000", "dashdot"] },
  plan: { name: "plan", several: true, look: ["#e69f00", "solid"] },
};

function linkedViews(view) {
  const runs = view.runs.map((run, i) => ({ ...run, number: i }));
  const single = runs.length === 1;
  const whole = new Map();
  const open = (run) => whole.get(run.number) || whole.set(run.number, unpacked(run)).get(run.number);
  const used = Object.keys(LAYERS).filter((name) => runs.some((run) => run.layers.includes(name)));
  const layers = new Set(used.filter((name) => single || LAYERS[name].several));
  const visible = () => runs.filter((run) => isShown(run.labels)).map(open);
  const plane = element("div", { class: "plot", id: "plane", role: "img", "aria-label": "Path in the plane" });
  const times = element("div", { class: "plot", id: "times", role: "img", "aria-label": "Errors, commands and step time over time" });
  const readout = element("dl", { class: "readout", id: "readout", "aria-live": "off" });
  const slider = element("input", { type: "range", class: "slider", id: "time", min: 0, max: 1000, value: 0, "aria-label": "Time of the cursor" });
  const key = element("div", { class: "strip-key" });
  const names = element("div", { class: "strip-key" });
  let cursor = null;

  const lineOf = (run, layer) => {
    const look = style(run.style);
    if (single) return layer in LAYERS ? { color: LAYERS[layer].look[0], dash: LAYERS[layer].look[1], width: 1.6 } : { color: "#0072b2", dash: "solid", width: 1.8 };
    if (layer === "reference" || layer === "limits") return { color: LAYERS[layer].look[0], dash: LAYERS[layer].look[1], width: 1.2 };
    return { color: look.colour, dash: layer in LAYERS ? "dot" : look.dash, width: layer in LAYERS ? 1 : 1.7 };
  };
  const scatter = (run, layer, x, y, more = {}) => ({ type: "scatter", mode: "lines", x, y, line: lineOf(run, layer), showlegend: false, ...more });

  function planeTraces(all) {
    const drawn = new Set();
    const references = layers.has("reference") ? all.filter((run) => !drawn.has(run.path) && drawn.add(run.path)) : [];
    const marks = (run) => ({ mode: "markers", marker: { color: single ? LAYERS.poses.look[0] : style(run.style).colour, symbol: "x-thin-open", size: 5, line: { width: 1 } } });
    return [
      ...references.map((run) => scatter(run, "reference", run.reference_x, run.reference_y, { line: { color: GREY, dash: "dot", width: 3 } })),
      ...(layers.has("poses") ? all.filter((run) => run.pose_x).map((run) => scatter(run, "poses", run.pose_x, run.pose_y, marks(run))) : []),
      ...(layers.has("estimate") ? all.filter((run) => run.estimate_x).map((run) => scatter(run, "estimate", run.estimate_x, run.estimate_y)) : []),
      ...all.map((run) => scatter(run, "true", run.x, run.y)),
    ];
  }

  // Domains of the panes from the top, the strip below them.
  function domains(rows) {
    const strip = 0.5 + 0.16 * Math.min(rows, 12);
    const sizes = [...PANES.map((pane) => pane.size), strip];
    const gap = 0.42;
    const total = sizes.reduce((sum, size) => sum + size + gap, 0);
    let top = 1;
    const found = sizes.map((size) => {
      const high = top - gap / total;
      top = high - size / total;
      return [Math.max(0, top), high];
    });
    return { found, height: 96 * total + 48 };
  }

  function timeTraces(all) {
    const traces = [];
    PANES.forEach((pane, i) => {
      const yaxis = `y${i ? i + 1 : ""}`;
      for (const [column, layer] of pane.lines) {
        if (layer in LAYERS && !layers.has(layer)) continue;
        for (const run of all) if (run[column]) traces.push(scatter(run, layer, run.t, run[column], { yaxis }));
      }
      const limit = all.map((run) => run[pane.limit]).find(Boolean);
      // Only the limits on the side to which commands go: the other would press the curves flat.
      for (const sign of limit && layers.has("limits") ? [-1, 1] : []) {
        const column = pane.lines[1][0];
        const end = all[0].t[all[0].t.length - 1];
        if (all.some((run) => run[column].some((value) => sign * value > 0.1 * limit))) traces.push(scatter(all[0], "limits", [0, end], [sign * limit, sign * limit], { yaxis }));
      }
    });
    all.forEach((run, row) => traces.push(...stripTraces(run, row)));
    return traces;
  }

  function stripTraces(run, row) {
    const yaxis = `y${PANES.length + 1}`;
    return Object.keys(run.strip).map((what) => {
      const x = run.strip[what].flatMap(([from, to]) => [from, to, null]);
      const [, color, width] = stripOf(what);
      return { type: "scatter", mode: "lines", x, y: x.map((value) => (value === null ? null : -row)), yaxis, line: { color, width: Math.min(width, single ? 16 : 9) }, showlegend: false };
    });
  }

  function timesLayout(all) {
    const { found, height } = domains(all.length);
    const made = { height, margin: { ...SVG_MARGIN, t: 0 }, annotations: [], xaxis: { ...GRID, title: { text: "time [s]", standoff: 6 }, anchor: `y${PANES.length + 1}` } };
    const titles = [...PANES.map((pane) => pane.title[single ? 0 : 1]), "way of the solver, and mode"];
    titles.forEach((title, i) => {
      made[`yaxis${i ? i + 1 : ""}`] = { ...GRID, domain: found[i], automargin: false, nticks: 5, zeroline: i < 2 };
      made.annotations.push({ xref: "paper", yref: "paper", x: 0, y: found[i][1], xanchor: "left", yanchor: "bottom", text: `<b>${escaped(title)}</b>`, showarrow: false, font: { size: 12 } });
    });
    const rows = all.map((_, row) => -row);
    Object.assign(made[`yaxis${titles.length}`], { range: [-all.length + 0.4, 0.6], tickvals: rows, ticktext: rows.map(() => ""), showgrid: false, zeroline: false, fixedrange: true });
    return layout(made);
  }

  function redraw() {
    const all = visible();
    if (!cursor || !all.some((run) => run === cursor.run)) cursor = all.length ? { run: all[0], t: cursor ? cursor.t : 0 } : null;
    const found = [...new Set(all.flatMap((run) => Object.keys(run.strip)))];
    key.replaceChildren(...found.map((what) => element("span", {}, swatch(stripOf(what)[1], "solid", Math.min(stripOf(what)[2], 10)), stripOf(what)[0])));
    if (!single) names.replaceChildren(...runNames(all));
    const spread = { ...GRID, scaleanchor: "x", scaleratio: 1, title: { text: "y [m]", standoff: 4 } };
    const flat = layout({ height: Math.min(460, Math.max(300, plane.clientWidth * 0.8)), margin: SVG_MARGIN, xaxis: { ...GRID, title: { text: "x [m]", standoff: 6 } }, yaxis: spread });
    return Promise.all([draw(plane, planeTraces(all), flat), draw(times, timeTraces(all), timesLayout(all))]).then(mark);
  }

  // Which line is whose, in the order of the strip's rows; print has no toggles.
  function runNames(all) {
    const named = all.slice(0, MOST_NAMED).map((run) => element("span", {}, swatch(style(run.style).colour, style(run.style).dash), run.name));
    return all.length > MOST_NAMED ? [...named, element("span", {}, `and ${all.length - MOST_NAMED} more`)] : named;
  }

  // The cursor: drawn over the plots, as a plot itself is slow to change.
  function overlay(place) {
    const found = place.querySelector(".cursor");
    if (found) return found;
    const made = svg("svg", { class: "cursor" });
    place.append(made);
    return made;
  }
  const pixel = (of, value) => of._offset + of.l2p(value);
  const indexAt = (run, t) => run.t.reduce((best, value, i) => (Math.abs(value - t) < Math.abs(run.t[best] - t) ? i : best), 0);
  const whatAt = (spans, t) => Object.keys(spans).find((what) => spans[what].some(([from, to]) => from <= t && t <= to));

  function mark() {
    const [flat, lines] = [overlay(plane), overlay(times)];
    flat.replaceChildren();
    lines.replaceChildren();
    if (!cursor || !plane._fullLayout || !times._fullLayout) return readout.replaceChildren();
    const { run, t } = cursor;
    const k = indexAt(run, t);
    markPlane(flat, run, k);
    const { xaxis } = times._fullLayout;
    const x = pixel(xaxis, run.t[k]);
    if (x >= xaxis._offset && x <= xaxis._offset + xaxis._length) lines.append(svg("line", { x1: x, x2: x, y1: 0, y2: times.clientHeight - SVG_MARGIN.b, stroke: "#1b2733", "stroke-width": 1 }));
    slider.value = String(Math.round((1000 * k) / Math.max(1, run.t.length - 1)));
    slider.setAttribute("aria-valuetext", `${run.t[k].toFixed(2)} s`);
    writeReadout(run, k);
  }

  function markPlane(flat, run, k) {
    const { xaxis, yaxis } = plane._fullLayout;
    const at = (x, y) => [pixel(xaxis, x), pixel(yaxis, y)];
    const plan = layers.has("plan") && run.plans ? run.plans[k] : null;
    if (plan) {
      const points = plan.map(([x, y]) => at(x, y));
      flat.append(svg("polyline", { points: points.map((one) => one.join(",")).join(" "), fill: "none", stroke: "#e69f00", "stroke-width": 3 }));
      points.slice(1).forEach(([cx, cy]) => flat.append(svg("circle", { cx, cy, r: 2.4, fill: "#fff", stroke: "#b37a00" })));
    }
    const [rx, ry] = at(run.reference_x[k], run.reference_y[k]);
    flat.append(svg("circle", { cx: rx, cy: ry, r: 6, fill: "none", stroke: GREY, "stroke-width": 2 }));
    const [x, y] = at(run.x[k], run.y[k]);
    const turned = (-run.theta[k] * 180) / Math.PI;
    flat.append(svg("path", { d: "M 10 0 L -7 6.5 L -3.5 0 L -7 -6.5 Z", transform: `translate(${x} ${y}) rotate(${turned})`, fill: single ? "#0072b2" : style(run.style).colour, stroke: "#fff", "stroke-width": 1.4 }));
  }

  function writeReadout(run, k) {
    const t = run.t[k];
    const value = (column, digits, unit) => (run[column] && run[column][k] !== null ? `${run[column][k].toFixed(digits)} ${unit}` : "-");
    const said = run.messages.filter(([from]) => from <= t).pop();
    const fields = [
      ["time", `${t.toFixed(2)} s`],
      ["lateral", value("lateral", 1, "mm")],
      ["along", value("along", 1, "mm")],
      ["heading", value("heading", 1, "mrad")],
      ["v command", value("v", 3, "m/s")],
      ["omega command", value("omega", 3, "rad/s")],
      ["step time", value("step", 3, "ms")],
      ["solver path", whatAt(run.paths, t) || "-"],
      ["mode", whatAt(run.modes, t) || "-"],
    ];
    const wide = [...(single ? [] : [["run", run.name]]), ...(said && said[1] ? [["message", said[1]]] : [])];
    const row = ([name, text], kind = "") => element("div", { class: kind, "data-name": name }, element("dt", {}, name), element("dd", {}, text));
    readout.replaceChildren(...wide.filter(([name]) => name === "run").map((one) => row(one, "wide")), ...fields.map((one) => row(one)), ...wide.filter(([name]) => name === "message").map((one) => row(one, "wide")));
  }

  // Which point of which run is nearest to a place in a plot.
  function nearestInPlane(event) {
    const { xaxis, yaxis } = plane._fullLayout;
    const box = plane.getBoundingClientRect();
    let best = null;
    for (const run of visible()) run.x.forEach((x, k) => {
      const far = Math.hypot(pixel(xaxis, x) - event.clientX + box.left, pixel(yaxis, run.y[k]) - event.clientY + box.top);
      if (!best || far < best.far) best = { far, run, t: run.t[k] };
    });
    return best && best.far < 60 ? best : null;
  }

  function nearestInTimes(event) {
    const full = times._fullLayout;
    const box = times.getBoundingClientRect();
    const y = event.clientY - box.top;
    const t = full.xaxis.p2l(event.clientX - box.left - full.xaxis._offset);
    const i = PANES.findIndex((_, j) => y < full[`yaxis${j ? j + 1 : ""}`]._offset + full[`yaxis${j ? j + 1 : ""}`]._length);
    const all = visible();
    if (i < 0) {
      const strip = full[`yaxis${PANES.length + 1}`];
      const row = Math.round(-strip.p2l(y - strip._offset));
      return all.length ? { run: all[Math.min(Math.max(row, 0), all.length - 1)], t } : null;
    }
    const of = full[`yaxis${i ? i + 1 : ""}`];
    const far = (run) => Math.abs(pixel(of, run[PANES[i].lines.at(i < 2 ? 0 : 1 % PANES[i].lines.length)[0]][indexAt(run, t)]) - y);
    return all.length ? { run: all.reduce((best, run) => (far(run) < far(best) ? run : best)), t } : null;
  }

  const follow = (nearest) => (event) => {
    const found = nearest(event);
    if (!found) return;
    cursor = { run: found.run, t: found.t };
    mark();
  };
  for (const [place, nearest] of [[plane, nearestInPlane], [times, nearestInTimes]]) {
    for (const kind of ["pointermove", "pointerdown"]) place.addEventListener(kind, follow(nearest), true);
  }
  slider.addEventListener("input", () => {
    if (!cursor) return;
    cursor.t = cursor.run.t[Math.round((slider.value / 1000) * (cursor.run.t.length - 1))];
    mark();
  });

  const boxes = used.map((name) => toggleBox("show", LAYERS[name].name, layers.has(name), single || name === "reference" ? swatch(...LAYERS[name].look) : null, (on) => {
    layers[on ? "add" : "delete"](name);
    redraw();
  }));
  const layerBar = element("fieldset", { class: "layers controls" }, element("legend", {}, "show"), ...boxes);
  const left = element("div", { class: "where" },
    element("div", { class: "card" }, element("h3", {}, "Path in the plane"), plane),
    element("div", { class: "card" }, slider, readout));
  const right = element("div", { class: "card" }, element("h3", {}, "Over time"), times, key, names, element("p", { class: "note" }, view.note));
  redraws.push(redraw);
  const after = () => times.on("plotly_relayout", mark) && plane.on("plotly_relayout", mark);
  return { parts: [layerBar, element("div", { class: "linked" }, left, right)], redraw: () => redraw().then(after), mark };
}
