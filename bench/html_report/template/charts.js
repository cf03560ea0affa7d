"use strict";
// Charts, maps and pictures; every drawn plot is kept in `plots`, so that print and a turned phone can resize it.
const FONT = { family: "system-ui, -apple-system, Segoe UI, Roboto, DejaVu Sans, sans-serif", size: 12, color: "#1b2733" };
const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], scrollZoom: false };
const GRID = { gridcolor: "#e6ebef", zerolinecolor: "#c5ced6", linecolor: "#c5ced6", automargin: true };
const plots = [];
const touch = window.matchMedia("(pointer: coarse)").matches;

function layout(more) {
  return { font: FONT, paper_bgcolor: "#fff", plot_bgcolor: "#fff", margin: { l: 52, r: 12, t: 12, b: 44 }, hovermode: false, dragmode: touch ? false : "zoom", ...more };
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
  const named = { ...GRID, title: { text: escaped(of.title), standoff: 8 }, type: of.type };
  return { ...named, ...(of.type === "log" ? logTicks(values) : {}), ...(of.range ? { range: of.range } : {}) };
}

function chartTrace(series) {
  const look = style(series.style);
  const common = { name: escaped(series.name), x: series.x, y: series.y, text: (series.text || []).map(escaped), hovertemplate: series.text ? "%{text}<extra></extra>" : undefined };
  if (series.kind === "bars") {
    return { ...common, type: "bar", marker: { color: look.colour, pattern: { shape: ["", "/", ".", "x", "-"][series.style % 5], fillmode: "overlay", fgcolor: "#fff", size: 6, solidity: 0.25 } } };
  }
  const between = series.low ? { type: "data", symmetric: false, array: series.high.map((v, i) => v - series.y[i]), arrayminus: series.low.map((v, i) => series.y[i] - v), thickness: 1.2 } : undefined;
  return {
    ...common, type: "scatter", error_y: between,
    mode: series.kind === "points" ? "markers" : series.kind === "line" ? "lines" : "lines+markers",
    line: { color: look.colour, dash: look.dash, width: 2 },
    marker: { color: look.colour, symbol: look.marker, size: 7, line: { color: "#fff", width: 1 } },
  };
}

function drawChart(chart, place) {
  const traces = chart.series.filter((one) => isShown(one.labels)).map(chartTrace);
  const shapes = chart.marks.map((mark) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: mark.value, y1: mark.value, line: { color: "#5a6875", dash: "dot", width: 1.5 } }));
  const annotations = chart.marks.map((mark) => ({ xref: "paper", x: 1, xanchor: "right", y: mark.value, yanchor: "bottom", text: escaped(mark.text), showarrow: false, font: { size: 11, color: "#5a6875" } }));
  return draw(place, traces, layout({
    height: chart.height, xaxis: axis(chart.x, traces.flatMap((one) => one.x)), yaxis: axis(chart.y, traces.flatMap((one) => one.y)), shapes, annotations, hovermode: "closest", barmode: "group",
    showlegend: chart.series.length > 1, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0, font: { size: 11 } }, margin: { l: 56, r: 12, t: 30, b: 48 },
  }));
}

function drawMap(map, place) {
  const crossed = map.crossed.map((row) => row.map((cross) => (cross ? "×" : "")));
  const trace = {
    type: "heatmap", x: map.x.values, y: map.y.values, z: map.values, text: crossed, texttemplate: "%{text}", textfont: { size: 16, color: "#fff" },
    colorscale: "Cividis", reversescale: false, colorbar: { title: { text: escaped(map.unit), side: "right" }, thickness: 12 },
    hovertemplate: `${escaped(map.x.title)}: %{x}<br>${escaped(map.y.title)}: %{y}<br>%{z} ${escaped(map.unit)}<extra></extra>`, hoverongaps: false,
  };
  return draw(place, [trace], layout({ height: 340, xaxis: axis(map.x, map.x.values), yaxis: axis(map.y, map.y.values), hovermode: "closest" }));
}

const DRAWN = { chart: drawChart, map: drawMap };

function chartCard(view) {
  const place = element("div", { class: "plot" });
  const note = view.note ? [element("p", { class: "note" }, view.note)] : [];
  const body = view.kind === "picture" ? element("img", { src: view.source, alt: view.title }) : place;
  const card = element("figure", { class: `card ${view.broad ? "broad" : ""}`, style: "margin:0" }, element("h3", {}, view.title), body, ...note);
  const redraw = () => DRAWN[view.kind](view, place);
  if (view.kind === "chart") redraws.push(redraw);
  return { card, redraw: view.kind === "picture" ? () => body.decode().catch(() => undefined) : redraw };
}
