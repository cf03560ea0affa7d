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

/* The part of a link after its #: whatever is not the default. */
function linkOf(choices, index) {
  const standard = defaultChoices(index);
  const words = Object.keys(index.choices)
    .filter((name) => choices[name] !== standard[name])
    .map((name) => `${name}=${choices[name]}`);
  for (const name of Object.keys(LISTS))
    if (choices[name].length) words.push(`${name}=${pointsText(choices[name])}`);
  return words.join("&");
}

/* What a link says: choices, or why it cannot be used. */
function readLink(text, index) {
  const choices = defaultChoices(index);
  if (text.length > index.longest_link) return { choices, fault: `it is longer than ${index.longest_link} characters` };
  const seen = new Set();
  for (const word of text.split("&").filter(Boolean)) {
    const [name, value = ""] = word.split("=", 2);
    if (seen.has(name)) return { choices: defaultChoices(index), fault: `'${name.slice(0, 20)}' stands there twice` };
    seen.add(name);
    const read = readWord(name, value, index);
    if (read === null) return { choices: defaultChoices(index), fault: `'${word.slice(0, 40)}' is no choice` };
    choices[name] = read;
  }
  return { choices, fault: "" };
}

function readWord(name, value, index) {
  if (Object.hasOwn(LISTS, name)) {
    const settings = index[name];
    return pointsOf(value, settings[LISTS[name]], index.drawn.reach);
  }
  if (!Object.hasOwn(index.choices, name)) return null;
  const known = index.choices[name].values.find((candidate) => String(candidate) === value);
  return known === undefined ? null : known;
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
  if (choices.ice.length) lines.push("# Painted ice is not part of it: simulate has one floor everywhere.");
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
