"use strict";
// Draws everything once; `data-ready` on the page says that all of it is there.
function writeViews() {
  const made = [];
  const marks = [];
  let charts = null;
  for (const view of content.views) {
    if (view.kind === "runs") {
      const linked = linkedViews(view);
      byId("views").append(...linked.parts);
      made.push(linked.redraw);
      marks.push(linked.mark);
      charts = null;
    } else {
      const chart = chartCard(view);
      if (!charts) byId("views").append((charts = element("div", { class: "charts" })));
      charts.append(chart.card);
      made.push(chart.redraw);
    }
  }
  const fit = () => Promise.all(plots.map((place) => Plotly.Plots.resize(place))).then(() => marks.forEach((mark) => mark()));
  window.addEventListener("resize", () => setTimeout(() => marks.forEach((mark) => mark()), 200));
  window.addEventListener("beforeprint", () => { document.documentElement.classList.add("printing"); fit(); });
  window.addEventListener("afterprint", () => { document.documentElement.classList.remove("printing"); fit(); });
  return Promise.all(made.map((redraw) => redraw()));
}

writeText();
writeToggles();
writeViews().then(() => requestAnimationFrame(() => document.documentElement.setAttribute("data-ready", "")));
