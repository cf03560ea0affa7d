"use strict";

/* The compiled laboratory, and the data that it is given. Nothing is computed here: arrays are put together by name. */
class Engine {
  constructor(exports, index, numbers) {
    this.c = exports;
    this.index = index;
    this.arrays = [];
    let begin = 0;
    for (const length of index.lengths) {
      this.arrays.push(numbers.subarray(begin, begin + length));
      begin += length;
    }
    this.slots = new Map();
    this.give("robot", this.arrays[index.robot]);
    this.give("peer", this.arrays[index.peer]);
    this.give("drawing", this.arrays[index.drawing]);
    this.give("ice", this.arrays[index.floors[index.ice.surface]]);
  }

  static async open(module, index, numbers, now) {
    const compiled = await WebAssembly.instantiate(module, { page: { now } });
    compiled.instance.exports._initialize?.();
    return new Engine(compiled.instance.exports, index, numbers);
  }

  view(address, count) {
    return new Float64Array(this.c.memory.buffer, address, count);
  }

  /* Put numbers into the laboratory's memory, and call lab_set_KIND with them; what was there before is given back. */
  give(kind, numbers) {
    const address = this.c.lab_allocate(numbers.length);
    this.view(address, numbers.length).set(numbers);
    const taken = this.c[`lab_set_${kind}`](address);
    const before = this.slots.get(kind);
    if (before !== undefined) this.c.lab_free(before);
    this.slots.set(kind, address);
    return taken;
  }

  /* The constants of a controller: those of its base, and the ones that are proportional to other choices. */
  controllerNumbers(choices) {
    const base = this.index.controllers[`${choices.model} ${choices.horizon} ${choices.told}`];
    const fields = base.fields.map((place) => this.arrays[place].slice());
    for (const [name, changes] of Object.entries(base.varied)) {
      const factor = choices[name] ** this.index.choices[name].power;
      for (const [field, places, array] of changes)
        places.forEach((place, i) => { fields[field][place] = factor * this.arrays[array][i]; });
    }
    const parts = [this.arrays[base.sizes], ...fields];
    const whole = new Float64Array(parts.reduce((sum, part) => sum + part.length, 0));
    let begin = 0;
    for (const part of parts) {
      whole.set(part, begin);
      begin += part.length;
    }
    return whole;
  }

  setWorld(choices) {
    const { index, arrays } = this;
    this.give("floor", arrays[index.floors[choices.surface]]);
    this.give("sensors", arrays[index.sensors[choices.sensors]]);
    this.give("noise", arrays[index.noise[choices.seed]]);
    this.give("model", arrays[index.models[`${choices.robot} ${choices.dead}`]]);
    const ice = choices.ice.flatMap(([x, y]) => [x, y, index.ice.radius]);
    this.give("patches", new Float64Array([choices.ice.length, ...ice]));
  }

  /* Whether there is such a path at such a speed, and it is the reference now. */
  setPath(choices) {
    if (choices.drawn.length) return this.draw(choices.drawn, choices.speed);
    const place = this.index.references[`${choices.path} ${choices.speed}`];
    if (place === undefined) return false;
    this.give("reference", this.arrays[place]);
    return true;
  }

  draw(points, speed) {
    const address = this.c.lab_allocate(2 * points.length);
    this.view(address, 2 * points.length).set(points.flat());
    const drawn = this.c.lab_draw(address, points.length, speed || this.index.drawn.speed);
    this.c.lab_free(address);
    return Boolean(drawn);
  }

  /* A drive from its beginning with these choices; whether the controller takes it. */
  start(choices) {
    this.setWorld(choices);
    if (!this.setPath(choices)) return false;
    this.give("controller", this.controllerNumbers(choices));
    this.steps = choices.horizon;
    return Boolean(this.c.lab_start());
  }

  tick() {
    this.c.lab_tick();
  }

  /* Numbers of the last tick by name. */
  report() {
    const fields = this.index.report;
    const names = Object.keys(fields);
    const [last, count] = fields[names.at(-1)];
    const all = this.view(this.c.lab_get_report(), last + count);
    return Object.fromEntries(names.map((name) => {
      const [place, length] = fields[name];
      return [name, length === 1 ? all[place] : Array.from(all.subarray(place, place + length))];
    }));
  }

  plan() {
    return Array.from(this.view(this.c.lab_plan(), 3 * (this.steps + 1)));
  }

  /* Poses and twists (5 numbers) of the reference, `step` seconds apart. */
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

  /* The whole drive at once: commands of each tick, and its figures. */
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

/* What a drive is judged by, as `simulate` prints it, to the end of the reference. */
function figures(report) {
  return {
    rms: Math.sqrt(report.square_sum / Math.max(report.counted, 1)),
    largest: report.largest,
    step: report.controller_seconds / Math.max(report.ticks, 1),
  };
}

/* What the page holds, unpacked. */
async function unpacked(name) {
  const text = document.getElementById(`held-${name}`).textContent;
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/* So many laboratories with memory of their own. */
async function openEngines(count) {
  const [module, numbers, text] = await Promise.all(["module", "numbers", "index"].map(unpacked));
  const index = JSON.parse(new TextDecoder().decode(text)), all = new Float64Array(numbers);
  const now = () => performance.now() / 1000;
  return Promise.all(Array.from({ length: count }, () => Engine.open(module, index, all, now)));
}
