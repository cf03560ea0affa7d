"use strict";

/* Interface to the compiled laboratory and its data. Arrays are selected by name and copied to its memory. */
class Engine {
  constructor(exports, index, numbers) {
    this.c = exports;
    this.index = index;
    this.arrays = [];
    let start = 0;
    for (const length of index.lengths) {
      this.arrays.push(numbers.subarray(start, start + length));
      start += length;
    }
    this.addresses = new Map();
    this.set("robot", this.arrays[index.robot]);
    this.set("peer", this.arrays[index.peer]);
    this.set("drawing", this.arrays[index.drawing]);
    this.set("ice", this.arrays[index.floors[index.ice.surface]]);
  }

  static async open(module, index, numbers, now) {
    const compiled = await WebAssembly.instantiate(module, { page: { now } });
    compiled.instance.exports._initialize?.();
    return new Engine(compiled.instance.exports, index, numbers);
  }

  view(address, count) {
    return new Float64Array(this.c.memory.buffer, address, count);
  }

  /* Copy numbers to the memory of the laboratory, pass them to lab_set_KIND, and free the previous ones. */
  set(kind, numbers) {
    const address = this.c.lab_allocate(numbers.length);
    this.view(address, numbers.length).set(numbers);
    this.c[`lab_set_${kind}`](address);
    const previous = this.addresses.get(kind);
    if (previous !== undefined) this.c.lab_free(previous);
    this.addresses.set(kind, address);
  }

  /* Return the constants of a controller: those of its base, some of them scaled by continuous choices. */
  controllerNumbers(choices) {
    const base = this.index.controllers[`${choices.model} ${choices.horizon} ${choices.told}`];
    const fields = base.fields.map((array) => this.arrays[array].slice());
    for (const [name, changes] of Object.entries(base.varied)) {
      const factor = choices[name] ** this.index.choices[name].power;
      for (const [field, indices, array] of changes)
        indices.forEach((index, i) => { fields[field][index] = factor * this.arrays[array][i]; });
    }
    const parts = [this.arrays[base.sizes], ...fields];
    const numbers = new Float64Array(parts.reduce((sum, part) => sum + part.length, 0));
    let start = 0;
    for (const part of parts) {
      numbers.set(part, start);
      start += part.length;
    }
    return numbers;
  }

  setWorld(choices) {
    const { index, arrays } = this;
    this.set("floor", arrays[index.floors[choices.surface]]);
    this.set("sensors", arrays[index.sensors[choices.sensors]]);
    this.set("noise", arrays[index.noise[choices.seed]]);
    this.set("model", arrays[index.models[`${choices.robot} ${choices.dead}`]]);
    const ice = choices.ice.flatMap(([x, y]) => [x, y, index.ice.radius]);
    this.set("patches", new Float64Array([choices.ice.length, ...ice]));
  }

  /* Set the reference; return false if the path is not possible at this speed. */
  setPath(choices) {
    if (choices.drawn.length) return this.setDrawnPath(choices.drawn, choices.speed);
    const array = this.index.references[`${choices.path} ${choices.speed}`];
    if (array === undefined) return false;
    this.set("reference", this.arrays[array]);
    return true;
  }

  setDrawnPath(points, speed) {
    const address = this.c.lab_allocate(2 * points.length);
    this.view(address, 2 * points.length).set(points.flat());
    const isPossible = this.c.lab_draw(address, points.length, speed || this.index.drawn.speed);
    this.c.lab_free(address);
    return Boolean(isPossible);
  }

  /* Start a drive; return false if path or controller cannot be used. */
  start(choices) {
    this.setWorld(choices);
    if (!this.setPath(choices)) return false;
    this.set("controller", this.controllerNumbers(choices));
    this.steps = choices.horizon;
    return Boolean(this.c.lab_start());
  }

  tick() {
    this.c.lab_tick();
  }

  /* Return the values of the last tick by name. */
  report() {
    const fields = this.index.report;
    const names = Object.keys(fields);
    const [lastStart, lastLength] = fields[names.at(-1)];
    const numbers = this.view(this.c.lab_get_report(), lastStart + lastLength);
    return Object.fromEntries(names.map((name) => {
      const [start, length] = fields[name];
      return [name, length === 1 ? numbers[start] : Array.from(numbers.subarray(start, start + length))];
    }));
  }

  plan() {
    return Array.from(this.view(this.c.lab_plan(), 3 * (this.steps + 1)));
  }

  /* Return rows of the reference at a period `step` [s]: time, pose (3) and twist (2). */
  referencePoints(step) {
    const duration = this.report().duration;
    const address = this.c.lab_allocate(5);
    const points = [];
    for (let k = 0; k * step < duration; k++) points.push([k * step]);
    points.push([duration]);
    for (const point of points) {
      this.c.lab_sample(point[0], address);
      point.push(...this.view(address, 5));
    }
    this.c.lab_free(address);
    return points;
  }

  /* Compute a complete drive; return the rows of all ticks and the figures. */
  drive(choices) {
    if (!this.start(choices)) return null;
    const commands = [], poses = [], peer = [], modes = [];
    const period = this.arrays[this.index.robot][0];
    const ticks = Math.ceil((this.report().duration - 1e-9) / period) + 1;
    for (let k = 0; k < ticks; k++) {
      this.tick();
      const report = this.report();
      commands.push(report.command);
      poses.push(report.pose);
      peer.push(report.peer_command);
      modes.push(report.mode);
    }
    return { commands, poses, peer, modes, ...figures(this.report()) };
  }
}

/* Return the figures of a drive up to the end of the reference, as `simulate` prints them. */
function figures(report) {
  return {
    rms: Math.sqrt(report.square_sum / Math.max(report.counted, 1)),
    largest: report.largest,
    step: report.controller_seconds / Math.max(report.ticks, 1),
  };
}

/* Decompress data that the page contains. */
async function unpack(name) {
  const text = document.getElementById(`held-${name}`).textContent;
  const compressed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/* Open a number of engines with separate memories. */
async function openEngines(count) {
  const [module, buffer, text] = await Promise.all(["module", "numbers", "index"].map(unpack));
  const index = JSON.parse(new TextDecoder().decode(text)), numbers = new Float64Array(buffer);
  const now = () => performance.now() / 1000;
  return Promise.all(Array.from({ length: count }, () => Engine.open(module, index, numbers, now)));
}
