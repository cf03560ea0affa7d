/* What is chosen, as words of a link and as files for `simulate`. */

const LISTS = { ice: "most", drawn: "most_points" };

function defaultChoices(index) {
  const chosen = Object.entries(index.choices).map(([name, choice]) => [name, choice.default]);
  return { ...Object.fromEntries(chosen), ice: [], drawn: [] };
}

/* Points as whole centimetres, and back; null where they are none, too many or too far away. */
function pointsText(points) {
  return points.map((point) => point.map((metres) => Math.round(100 * metres)).join(",")).join(";");
}

function pointsOf(text, most, reach) {
  if (!/^-?\d{1,4},-?\d{1,4}(;-?\d{1,4},-?\d{1,4})*$/.test(text)) return null;
  const points = text.split(";").map((pair) => pair.split(",").map((number) => Number(number) / 100));
  const fits = points.length <= most && points.flat().every((metres) => Math.abs(metres) <= reach);
  return fits ? points : null;
}

/* The part of a link after its # for one drive: its path, and the settings that are not the default. */
function linkOf(choices, index, prefix = "") {
  const standard = defaultChoices(index);
  const words = Object.keys(index.choices)
    .filter((name) => (name === "path" ? !choices.drawn.length : choices[name] !== standard[name]))
    .map((name) => `${prefix}${name}=${choices[name]}`);
  for (const name of Object.keys(LISTS))
    if (choices[name].length) words.push(`${prefix}${name}=${pointsText(choices[name])}`);
  return words.join("&");
}

/* Read a link: the settings by side (those with a prefix are of the side that is not marked), or its fault. */
function readLink(text, index) {
  const sides = { "": defaultChoices(index) }, names = new Set();
  if (text.length > index.longest_link) return { fault: `it is longer than ${index.longest_link} characters` };
  for (const word of text.split("&").filter(Boolean)) {
    const [full, value = ""] = word.split("=", 2), [, prefix, name] = /^([ab]\.)?(.*)$/s.exec(full);
    if (names.has(full)) return { fault: `'${full.slice(0, 20)}' is in it twice` };
    names.add(full);
    const read = readWord(name, value, index);
    if (read === null) return { fault: `'${word.slice(0, 40)}' is no choice` };
    (sides[prefix ?? ""] ??= defaultChoices(index))[name] = read;
  }
  const { "": marked, "a.": a, "b.": b } = sides;
  if (a && b) return { fault: "it names more than two drives" };
  return b ? { a: marked, b, side: "a", fault: "" } : { a: a ?? null, b: marked, side: "b", fault: "" };
}

function readWord(name, value, index) {
  if (Object.hasOwn(LISTS, name)) return pointsOf(value, index[name][LISTS[name]], index.drawn.reach);
  if (!Object.hasOwn(index.choices, name)) return null;
  const choice = index.choices[name], number = Number(value);
  if (choice.power && nearest(choice, number) === number && String(number) === value) return number;
  return choice.values.find((candidate) => String(candidate) === value) ?? null;
}

/* The value of a choice nearest to a number: any in its range, or one of a list. */
function nearest({ power, values }, number) {
  if (power) return Math.min(Math.max(number, values[0]), values.at(-1));
  return values.reduce((best, value) => (Math.abs(value - number) < Math.abs(best - number) ? value : best));
}

/* The settings of a drive that are not those of the other. */
function differences(choices, rival, index) {
  const words = Object.entries(index.choices)
    .filter(([name]) => choices[name] !== rival[name])
    .map(([name, choice]) => `${choice.label}: ${choices[name]}`);
  if (pointsText(choices.ice) !== pointsText(rival.ice)) words.push(choices.ice.length ? "with ice" : "without ice");
  return words.join("; ");
}

/* The configuration's values by key, in groups. */
function configurationOf(choices, index) {
  const config = { model: choices.model, ...structuredClone(index.files[choices.model]) };
  for (const [name, choice] of Object.entries(index.choices)) {
    if (!choice.key) continue;
    const keys = name === "told" ? [`${choice.key}.v`, `${choice.key}.omega`] : [choice.key];
    for (const key of keys) {
      const [last, ...groups] = key.split(".").reverse();
      let place = config;
      for (const group of groups.reverse()) place = place[group] ??= {};
      place[last] = choices[name];
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

/* Whole numbers stay whole only where the schema has whole ones: the horizon. JSON's scalars are YAML's. */
function scalar(value) {
  return JSON.stringify(value);
}

/* The shipped path drives by its name; at another speed, or drawn, it needs a file of its own. */
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

/* The file to take away; `whole` are the figures of the whole drive, where they are known. */
function configFile(choices, index, whole) {
  const lines = ["# From the laboratory of diffdrive-mpc. It is driven by", `# ${commandOf(choices)}`];
  if (needsPathFile(choices)) lines.push(`# with the path that the page gives as ${FILES.path}.`);
  if (choices.ice.length) lines.push("# Painted ice is not part of it: simulate has one surface everywhere.");
  if (whole) lines.push(`# In the page: position RMSE ${millimetres(whole.rms)}, max ${millimetres(whole.largest)}.`);
  return `${[...lines, ...yamlLines(configurationOf(choices, index))].join("\n")}\n`;
}

function pathFile(points) {
  const rows = points.map(([time, x, y, heading]) => [time, x, y, heading].join(","));
  return `${["t,x,y,theta", ...rows].join("\n")}\n`;
}

function millimetres(metres) {
  return `${(1000 * metres).toFixed(1)} mm`;
}
