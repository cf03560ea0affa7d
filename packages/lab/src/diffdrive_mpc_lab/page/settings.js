/* Settings of a drive ("choices") as text of a link, and as files for `simulate`. */

const LISTS = { ice: "most", drawn: "most_points" };

function defaultChoices(index) {
  const defaults = Object.entries(index.choices).map(([name, choice]) => [name, choice.default]);
  return { ...Object.fromEntries(defaults), ice: [], drawn: [] };
}

/* Format points in whole centimetres. */
function pointsText(points) {
  return points.map((point) => point.map((metres) => Math.round(100 * metres)).join(",")).join(";");
}

/* Read the format of `pointsText`; null if the text is invalid, or if points are too many or too far away. */
function pointsOf(text, maxCount, reach) {
  if (!/^-?\d{1,4},-?\d{1,4}(;-?\d{1,4},-?\d{1,4})*$/.test(text)) return null;
  const points = text.split(";").map((pair) => pair.split(",").map((number) => Number(number) / 100));
  const isValid = points.length <= maxCount && points.flat().every((metres) => Math.abs(metres) <= reach);
  return isValid ? points : null;
}

/* Format the settings of one drive for the part of a link after its #: the path, and values that are not the default. */
function linkOf(choices, index, prefix = "") {
  const defaults = defaultChoices(index);
  const pairs = Object.keys(index.choices)
    .filter((name) => (name === "path" ? !choices.drawn.length : choices[name] !== defaults[name]))
    .map((name) => `${prefix}${name}=${choices[name]}`);
  for (const name of Object.keys(LISTS))
    if (choices[name].length) pairs.push(`${prefix}${name}=${pointsText(choices[name])}`);
  return pairs.join("&");
}

/* Read the settings of both sides from a link, or its fault; names with a prefix belong to the side not selected. */
function readLink(text, index) {
  const sides = { "": defaultChoices(index) }, names = new Set();
  if (text.length > index.longest_link) return { fault: `it is longer than ${index.longest_link} characters` };
  for (const pair of text.split("&").filter(Boolean)) {
    const [key, valueText = ""] = pair.split("=", 2), [, prefix, name] = /^([ab]\.)?(.*)$/s.exec(key);
    if (names.has(key)) return { fault: `it contains '${key.slice(0, 20)}' twice` };
    names.add(key);
    const value = readValue(name, valueText, index);
    if (value === null) return { fault: `'${pair.slice(0, 40)}' is not a valid choice` };
    (sides[prefix ?? ""] ??= defaultChoices(index))[name] = value;
  }
  const { "": selected, "a.": a, "b.": b } = sides;
  if (a && b) return { fault: "it contains more than two drives" };
  return b ? { a: selected, b, side: "a", fault: "" } : { a: a ?? null, b: selected, side: "b", fault: "" };
}

/* Read the value of a choice; null if it is invalid. */
function readValue(name, text, index) {
  if (Object.hasOwn(LISTS, name)) return pointsOf(text, index[name][LISTS[name]], index.drawn.reach);
  if (!Object.hasOwn(index.choices, name)) return null;
  const choice = index.choices[name], number = Number(text);
  if (choice.power && nearest(choice, number) === number && String(number) === text) return number;
  return choice.values.find((candidate) => String(candidate) === text) ?? null;
}

/* Return the value of a choice nearest to a number: from its range if it has a power, else from its list. */
function nearest({ power, values }, number) {
  if (power) return Math.min(Math.max(number, values[0]), values.at(-1));
  return values.reduce((best, value) => (Math.abs(value - number) < Math.abs(best - number) ? value : best));
}

/* Describe the possible values of a choice. */
function possibleValues({ power, values }) {
  return power ? `${values[0]} to ${values.at(-1)}` : values.join(", ");
}

/* Return the step of a number field: the difference of the two largest values of a list; any number has no step. */
function stepOf({ power, values }) {
  return power ? "any" : Number((values.at(-1) - values.at(-2)).toFixed(6));
}

/* Describe the settings of a drive that differ from those of the drive that it is compared with. */
function differences(choices, comparedChoices, index) {
  const parts = Object.entries(index.choices)
    .filter(([name]) => choices[name] !== comparedChoices[name])
    .map(([name, choice]) => `${choice.label}: ${choices[name]}`);
  if (pointsText(choices.ice) !== pointsText(comparedChoices.ice))
    parts.push(choices.ice.length ? "with ice" : "without ice");
  return parts.join("; ");
}

/* Return the configuration of the controller as nested groups. */
function configurationOf(choices, index) {
  const config = { model: choices.model, ...structuredClone(index.files[choices.model]) };
  for (const [name, choice] of Object.entries(index.choices)) {
    if (!choice.key) continue;
    const keys = name === "told" ? [`${choice.key}.v`, `${choice.key}.omega`] : [choice.key];
    for (const key of keys) {
      const [field, ...groups] = key.split(".").reverse();
      let target = config;
      for (const group of groups.reverse()) target = target[group] ??= {};
      target[field] = choices[name];
    }
  }
  config.extra_dead_time.provenance = "chosen in the laboratory";
  return config;
}

function yamlLines(values, indent = "") {
  return Object.entries(values).flatMap(([key, value]) => {
    const isGroup = typeof value === "object" && value !== null && !Array.isArray(value);
    return isGroup ? [`${indent}${key}:`, ...yamlLines(value, `${indent}  `)] : [`${indent}${key}: ${scalar(value)}`];
  });
}

/* JSON scalars are valid YAML. The schema requires an integer for the horizon only, and accepts integers elsewhere. */
function scalar(value) {
  return JSON.stringify(value);
}

/* Return true if `simulate` needs a file of the path: a drawn path, or a shipped path at another speed. */
function needsPathFile(choices) {
  return choices.drawn.length > 0 || choices.speed !== 0;
}

const FILES = { config: "lab.yaml", path: "lab-path.csv" };

function commandOf(choices) {
  const path = needsPathFile(choices) ? FILES.path : choices.path;
  return [
    `diffdrive-mpc simulate --config ${FILES.config} --trajectory ${path}`,
    `--plant model:${choices.robot}+${choices.dead}`,
    `--surface ${choices.surface} --sensors ${choices.sensors} --seed ${choices.seed}`,
  ].join(" ");
}

/* Format the configuration file; `evaluation` has the errors of the complete drive, or is null. */
function configFile(choices, index, evaluation) {
  const lines = ["# From the laboratory of diffdrive-mpc. Simulate this drive with", `# ${commandOf(choices)}`];
  if (needsPathFile(choices)) lines.push(`# and with the file ${FILES.path} from the page.`);
  if (choices.ice.length) lines.push("# Painted ice is not included: simulate has the same surface everywhere.");
  if (evaluation) {
    const { rms, largest } = evaluation;
    lines.push(`# Result in the page, undisturbed: position RMSE ${millimetres(rms)}, max ${millimetres(largest)}.`);
  }
  return `${[...lines, ...yamlLines(configurationOf(choices, index))].join("\n")}\n`;
}

function pathFile(points) {
  const rows = points.map(([time, x, y, heading]) => [time, x, y, heading].join(","));
  return `${["t,x,y,theta", ...rows].join("\n")}\n`;
}

function millimetres(metres) {
  return `${(1000 * metres).toFixed(1)} mm`;
}
