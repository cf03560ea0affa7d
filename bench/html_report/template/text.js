"use strict";
// Writes the text of the page. Content is always inserted as text, never as markup.
const content = JSON.parse(document.getElementById("content").textContent);
const byId = (id) => document.getElementById(id);

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// Text between backticks is code.
const inlineNodes = (text) => text.split("`").map((part, i) => (i % 2 ? element("code", {}, part) : part));
const sentence = (text) => inlineNodes(/[.!?]$/.test(text) ? text : `${text}.`);

function keyFigure(figure) {
  return element("div", { class: `key-figure ${figure.state}` },
    element("div", { class: "label" }, figure.label),
    element("div", { class: "value" }, figure.value),
    element("p", { class: "note" }, figure.note));
}

function tableCard(table) {
  const kind = (i) => (i < table.text_columns ? "text" : "number");
  const head = element("tr", {}, ...table.columns.map((name, i) => element("th", { class: kind(i), scope: "col" }, name)));
  const rows = table.rows.map((row) => element("tr", {}, ...row.map((cell, i) => element("td", { class: kind(i) }, cell))));
  const scrollable = element("div", { class: "scroll", tabindex: "0" },
    element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows)));
  const parts = [scrollable, ...(table.note ? [element("p", { class: "note" }, ...inlineNodes(table.note))] : [])];
  if (table.rows.length <= 24) return element("div", { class: "card table" }, element("h3", {}, table.title), ...parts);
  const details = element("details", {}, element("summary", {}, `${table.title}: ${table.rows.length} rows`), ...parts);
  return element("div", { class: "card table" }, details);
}

function warningCard(warning) {
  const remedy = warning.remedy ? [element("p", { class: "remedy" }, "What to do: ", ...sentence(warning.remedy))] : [];
  return element("div", { class: "card warning" }, element("p", {}, ...sentence(warning.text)), ...remedy);
}

function configurationCard(configuration) {
  return element("details", { class: "card configuration" },
    element("summary", {}, configuration.name), element("pre", { tabindex: "0" }, configuration.text));
}

function facts(pairs) {
  return element("dl", { class: "facts" }, ...pairs.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

function fill(id, title, parts) {
  const section = byId(id);
  if (!parts.length) return section.remove();
  section.append(...parts);
  if (title) byId("contents").append(element("a", { href: `#${id}` }, title));
}

function writeText() {
  byId("command").textContent = content.command;
  byId("title").textContent = content.title;
  byId("key-figures").append(...content.key_figures.map(keyFigure));
  byId("sentences").append(...content.summary.map((line) => element("p", {}, ...inlineNodes(line))), ...content.notes.map((line) => element("p", { class: "note" }, ...inlineNodes(line))));
  fill("views", "Views", content.views.length ? [""] : []);
  fill("tables", "Tables", content.tables.map(tableCard));
  const count = content.warnings.length;
  const link = count === 1 ? "1 warning, with its remedy" : `${count} warnings, each with its remedy`;
  if (count) byId("sentences").prepend(element("p", {}, element("a", { href: "#warnings" }, link)));
  const noWarnings = element("p", {}, "No warnings.");
  fill("warnings", count ? `Warnings (${count})` : "Warnings", count ? content.warnings.map(warningCard) : [noWarnings]);
  fill("configuration", "Configuration", content.configurations.map(configurationCard));
  fill("repeat", "How to repeat", [element("div", { class: "card" },
    element("pre", { tabindex: "0" }, content.origin.command), facts(content.origin.facts))]);
}
