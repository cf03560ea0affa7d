"use strict";
// Charts, maps and pictures; every drawn plot is kept in `plots`, so that print and a turned phone can resize it.
const FONT = { family: "system-ui, -apple-system, Segoe UI, Roboto, DejaVu Sans, sans-serif", size: 12, color: "#1b2733" };
const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], scrollZoom: false };
const GRID = { gridcolor: "#e6ebef", zerolinecolor: "#c5ced6", linecolor: "#c5ced6", automargin: true };
// Upright in the right margin, where neither legend nor curves are.
const TOOLBAR = { orientation: "v", bgcolor: "rgba(255,255,255,0)" };
const plots = [];
const touch = window.matchMedia("(pointer: coarse)").matches;

function layout(more) {
  return { font: FONT, paper_bgcolor: "#fff", plot_bgcolor: "#fff", margin: { l: 52, r: 40, t: 12, b: 44 }, modebar: TOOLBAR, hovermode: false, dragmode: touch ? false : "zoom", ...more };
}

function draw(place, traces, made) {
  if (!plots.includes(place)) plots.push(place);
  return Plotly.react(place, traces, made, CONFIG);
}

// Labels of a logarithmic axis: 1, 2, 5 in each decade where there are few, else 1.
function logTicks(values) {
  const found = values.filter((value) => value > 0);
  const decades = found.length ? Math.log10(Math.max(...found) / Math.min(...found)) : 1;
  const steps = decades < 2.2 ? [1, 2, 5] : [1];
  const tickvals = [...Array(15).keys()].flatMap((k) => steps.map((step) => Number(`${step}e${k - 8}`)));
  return { tickvals, ticktext: tickvals.map(String) };
}

function axis(of, values) {
  const found = values.filter((value) => value > 0);
  const wide = Math.max(...found) > 4 * Math.min(...found);
  const named = { ...GRID, title: { text: escaped(of.title), standoff: 8 }, type: of.type === "log" && !wide ? "linear" : of.type };
  return { ...named, ...(named.type === "log" ? logTicks(values) : {}), ...(of.range ? { range: of.range } : {}) };
}

function chartTrace(series) {
  const look = style(series.style);
  const common = { name: escaped(series.name), x: series.x, y: series.y, text: (series.text || []).map(escaped), hovertemplate: series.text ? "%{text}<extra></extra>" : undefined };
  if (series.kind === "bars" || series.kind === "rows") {
    return { ...common, type: "bar", orientation: series.kind === "rows" ? "h" : "v", marker: { color: look.colour, pattern: { shape: ["", "/", ".", "x", "-"][series.style % 5], fillmode: "overlay", fgcolor: "#fff", size: 6, solidity: 0.25 } } };
  }
  const between = series.low ? { type: "data", symmetric: false, array: series.high.map((v, i) => v - series.y[i]), arrayminus: series.low.map((v, i) => series.y[i] - v), thickness: 1.2 } : undefined;
  return {
    ...common, type: "scatter", error_y: between,
    mode: series.kind === "points" ? "markers" : series.kind === "line" ? "lines" : "lines+markers",
    line: { color: look.colour, dash: look.dash, width: 2 },
    marker: { color: look.colour, symbol: look.marker, size: 7, line: { color: "#fff", width: 1 } },
  };
}

const across = (mark, at) => (mark.upright ? { yref: "paper", y0: 0, y1: 1, x0: at, x1: at } : { xref: "paper", x0: 0, x1: 1, y0: at, y1: at });

// On a logarithmic axis a label stands at the logarithm, a line does not.
function label(mark, chart) {
  const at = (mark.upright ? chart.x : chart.y).type === "log" ? Math.log10(mark.value) : mark.value;
  return mark.upright ? { x: at, xanchor: "left", yref: "paper", y: 1, yanchor: "top" } : { xref: "paper", x: 1, xanchor: "right", y: at, yanchor: "bottom" };
}

function drawChart(chart, place) {
  const traces = chart.series.filter((one) => isShown(one.labels)).map(chartTrace);
  const shapes = chart.marks.map((mark) => ({ type: "line", line: { color: "#5a6875", dash: "dot", width: 1.5 }, ...across(mark, mark.value) }));
  const annotations = chart.marks.map((mark) => ({ text: escaped(mark.text), showarrow: false, font: { size: 11, color: "#5a6875" }, ...label(mark, chart) }));
  return draw(place, traces, layout({
    height: chart.height, xaxis: axis(chart.x, traces.flatMap((one) => one.x)), yaxis: { ...axis(chart.y, traces.flatMap((one) => one.y)), ...(chart.series.some((one) => one.kind === "rows") ? { autorange: "reversed" } : {}) }, shapes, annotations, hovermode: "closest", barmode: "group",
    showlegend: chart.series.length > 1, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0, font: { size: 11 } }, margin: { l: 56, r: 40, t: 30, b: 48 },
  }));
}

function drawMap(map, place) {
  const crossed = map.crossed.map((row) => row.map((cross) => (cross ? "×" : "")));
  const logarithms = map.values.map((row) => row.map((value) => (value > 0 ? Math.log10(value) : null)));
  const ticks = logTicks(map.values.flat());
  const trace = {
    type: "heatmap", x: map.x.values, y: map.y.values, z: logarithms, customdata: map.values, text: crossed, texttemplate: "%{text}", textfont: { size: 16, color: "#fff" },
    colorscale: "Cividis", reversescale: false, colorbar: { title: { text: escaped(map.unit), side: "right" }, thickness: 12, tickvals: ticks.tickvals.map(Math.log10), ticktext: ticks.ticktext },
    hovertemplate: `${escaped(map.x.title)}: %{x}<br>${escaped(map.y.title)}: %{y}<br>%{customdata} ${escaped(map.unit)}<extra></extra>`, hoverongaps: false,
  };
  return draw(place, [trace], layout({ height: 360, margin: { l: 52, r: 12, t: 34, b: 44 }, modebar: { ...TOOLBAR, orientation: "h" }, xaxis: axis(map.x, map.x.values), yaxis: axis(map.y, map.y.values), hovermode: "closest" }));
}

const DRAWN = { chart: drawChart, map: drawMap };

function chartCard(view) {
  const place = element("div", { class: "plot" });
  const note = view.note ? [element("p", { class: "note" }, view.note)] : [];
  const body = view.kind === "picture" ? element("img", { src: view.source, alt: view.title }) : place;
  const card = element("figure", { class: `card ${view.broad ? "broad" : ""}` }, element("h3", {}, view.title), body, ...note);
  const redraw = () => DRAWN[view.kind](view, place);
  if (view.kind === "chart") redraws.push(redraw);
  return { card, redraw: view.kind === "picture" ? () => body.decode().catch(() => undefined) : redraw };
}
