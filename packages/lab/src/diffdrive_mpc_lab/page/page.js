/* The page itself: controls, the pointer, and the clock. */

const MODES = ["TRACKING", "REUSED_PLAN", "BRAKING", "STOPPED", "FINISHED"];
const LIVE = ["dead", "surface", "ice"]; /* choices that a drive under way takes */
const TOOLS = { carry: "Carry the robot", ice: "Paint ice", draw: "Draw a path" };
const MOST_TICKS = 6; /* of one picture: a slow machine falls behind rather than stand still */
const SLICE = 6; /* how long the whole drive may be worked on between two pictures [ms] */
const REST = 1.5; /* time that a drive has ended before it begins again [s] */
const element = (id) => document.getElementById(id);

function made(kind, properties, ...children) {
  const node = Object.assign(document.createElement(kind), properties);
  node.append(...children);
  return node;
}

class Laboratory {
  constructor(engine, judge) {
    this.engine = engine;
    this.judge = judge; /* drives the whole path for the figures */
    this.index = engine.index;
    this.period = engine.arrays[this.index.robot][0];
    const colours = new Colours();
    this.floor = new FloorView(element("floor"), this.index, colours);
    this.charts = new TimeView(element("charts"), this.index, colours);
    this.calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    Object.assign(this, { tool: "carry", paused: this.calm, covered: false, peer: true, held: false });
    Object.assign(this, { experiment: "", job: 0, owed: 0, pictures: [] });
    this.makeExperiments();
    this.makeTools();
    this.makeChoices();
    this.listen();
    this.openLink();
    requestAnimationFrame((now) => this.picture(now));
  }

  /* What is set. */

  openLink() {
    const { choices, fault } = readLink(safeDecoded(location.hash.slice(1)), this.index);
    this.choices = choices;
    let complaint = fault;
    if (!fault && !this.engine.start(choices)) {
      complaint = "its path, speed and limits do not go together";
      this.choices = defaultChoices(this.index);
    }
    this.notice(complaint && `This link cannot be used, so the default is shown: ${complaint}.`);
    this.restart();
  }

  notice(text) {
    element("notice").textContent = text;
    element("notice").hidden = !text;
  }

  /* Take other choices: a drive under way goes on with those of the floor and the dead time, others begin a new one. */
  choose(changes) {
    const before = this.choices;
    this.choices = { ...before, ...changes };
    this.notice("");
    this.tellExperiment();
    if (Object.keys(changes).every((name) => LIVE.includes(name))) {
      this.engine.setWorld(this.choices);
      this.settle();
      return;
    }
    if (this.restart()) return;
    this.choices = before;
    this.restart();
    this.notice("This path does not go together with that speed: it would be faster than the limits allow.");
  }

  restart() {
    if (!this.engine.start(this.choices)) return false;
    this.engine.c.lab_set_cover(this.covered ? 1 : 0);
    this.floor.clear();
    this.charts.clear();
    this.floor.frame(this.engine.referencePoints(0.05));
    this.report = this.engine.report();
    this.plan = [];
    this.owed = 0;
    this.ended = 0;
    this.settle();
    return true;
  }

  /* The link, the controls and the figures of what is set. */
  settle() {
    history.replaceState(null, "", `#${linkOf(this.choices, this.index)}`);
    this.showChoices();
    element("command").textContent = commandOf(this.choices);
    element("savepath").hidden = !needsPathFile(this.choices);
    this.whole = null;
    element("rms").textContent = element("largest").textContent = "…";
    this.judgeWhole(++this.job);
  }

  /* Drive the whole path in the second laboratory, a slice at a time. */
  async judgeWhole(job) {
    const { judge } = this;
    if (!judge.start(this.choices)) return;
    const poses = [], ticks = Math.ceil((judge.report().duration - 1e-9) / this.period) + 1;
    for (let k = 0; k < ticks; ) {
      const until = performance.now() + SLICE;
      for (; k < ticks && performance.now() < until; k++) {
        judge.tick();
        poses.push(judge.report().pose);
      }
      await new Promise((go) => setTimeout(go));
      if (job !== this.job) return;
    }
    this.whole = { poses, ...figures(judge.report()) };
    element("rms").textContent = millimetres(this.whole.rms);
    element("largest").textContent = millimetres(this.whole.largest);
    document.documentElement.dataset.judged = linkOf(this.choices, this.index);
  }

  /* What is on the page. */

  makeExperiments() {
    for (const experiment of this.index.experiments) {
      const buttons = ["a", "b"].map((side) => made("button", {
        type: "button", id: `${experiment.name}-${side}`, textContent: side.toUpperCase(),
        ariaLabel: `${experiment.title} ${side.toUpperCase()}`, onclick: () => this.openExperiment(experiment, side),
      }));
      element("experiments").append(made("article", { className: "experiment" },
        made("h2", { textContent: experiment.title }), made("p", { textContent: experiment.question }),
        made("div", { className: "row" }, ...buttons)));
    }
  }

  openExperiment(experiment, side) {
    this.choose({ ...defaultChoices(this.index), ...experiment[side] });
    this.experiment = `${experiment.name}-${side}`;
    this.tellExperiment(experiment.see);
    this.paused = this.calm;
    this.showDeeds();
  }

  tellExperiment(text = "") {
    if (!text) this.experiment = "";
    element("seen").textContent = text && `What is to be seen: ${text}`;
    element("seen").hidden = !text;
    for (const button of document.querySelectorAll(".experiment button"))
      button.ariaPressed = String(button.id === this.experiment);
  }

  makeTools() {
    for (const [tool, label] of Object.entries(TOOLS))
      element("tools").append(made("button", {
        type: "button", id: `tool-${tool}`, role: "radio", textContent: label, onclick: () => this.takeTool(tool),
      }));
    const deeds = {
      pause: ["Pause", () => this.pause()], again: ["Begin again", () => this.restart()],
      push: ["Push", () => this.push()], cover: ["Cover the pose sensor", () => this.cover()],
      thaw: ["Remove the ice", () => this.choose({ ice: [] })],
      shipped: ["Remove the drawn path", () => this.choose({ drawn: [] })],
      peer: ["Pure pursuit", () => { this.peer = !this.peer; this.showDeeds(); }],
    };
    for (const [name, [label, deed]] of Object.entries(deeds))
      element("deeds").append(made("button", { type: "button", id: name, textContent: label, onclick: deed }));
    this.takeTool("carry");
  }

  takeTool(tool) {
    this.tool = tool;
    for (const name of Object.keys(TOOLS)) element(`tool-${name}`).ariaChecked = String(name === tool);
    element("floor").style.cursor = tool === "carry" ? "grab" : "crosshair";
  }

  showDeeds() {
    element("pause").textContent = this.paused ? "Drive" : "Pause";
    element("pause").ariaPressed = String(this.paused);
    element("cover").ariaPressed = String(this.covered);
    element("peer").ariaPressed = String(this.peer);
    element("thaw").hidden = !this.choices.ice.length;
    element("shipped").hidden = !this.choices.drawn.length;
  }

  makeChoices() {
    const groups = new Map();
    for (const [name, choice] of Object.entries(this.index.choices)) {
      if (!groups.has(choice.group)) {
        groups.set(choice.group, made("fieldset", {}, made("legend", { textContent: choice.group })));
        element("choices").append(groups.get(choice.group));
      }
      const isNumber = choice.values.every((value) => typeof value === "number") && choice.values.length > 2;
      groups.get(choice.group).append(...(isNumber ? this.slider(name, choice) : this.list(name, choice)));
    }
    element("choices").onsubmit = (event) => event.preventDefault();
  }

  list(name, choice) {
    const options = choice.values.map((value) => made("option", { value, textContent: value }));
    if (name === "path") options.push(made("option", { value: "", textContent: "drawn", hidden: true }));
    const select = made("select", { id: `choice-${name}` }, ...options);
    select.onchange = () => {
      const value = choice.values.find((candidate) => String(candidate) === select.value);
      this.choose(name === "path" ? { path: value, drawn: [] } : { [name]: value });
    };
    return [made("label", { htmlFor: select.id, textContent: choice.label, title: choice.help ?? "" }), select];
  }

  slider(name, choice) {
    const last = choice.values.length - 1;
    const input = made("input", { type: "range", id: `choice-${name}`, min: 0, max: last, step: 1 });
    input.oninput = () => this.choose({ [name]: choice.values[Number(input.value)] });
    const label = made("label", { htmlFor: input.id, title: choice.help ?? "" }, choice.label);
    label.append(made("output", { id: `value-${name}` }));
    return [label, input];
  }

  showChoices() {
    for (const [name, choice] of Object.entries(this.index.choices)) {
      const input = element(`choice-${name}`), value = this.choices[name];
      const words = String(choice.named?.[value] ?? value);
      if (input.type === "range") {
        input.value = choice.values.indexOf(value);
        input.ariaValueText = element(`value-${name}`).textContent = words;
      } else input.value = name === "path" && this.choices.drawn.length ? "" : String(value);
    }
    this.showDeeds();
  }

  /* What a person does to the robot. */

  pause() {
    this.paused = !this.paused;
    this.showDeeds();
  }

  push() {
    const { left, turn, ticks } = this.index.push;
    this.engine.c.lab_push(left, turn, ticks);
  }

  cover() {
    this.covered = !this.covered;
    this.engine.c.lab_set_cover(this.covered ? 1 : 0);
    this.showDeeds();
  }

  carry(x, y, heading = this.report.pose[2]) {
    this.engine.c.lab_place(x, y, heading);
    this.report = { ...this.report, pose: [x, y, heading] };
  }

  listen() {
    const canvas = element("floor");
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.floor.stroke = [];
      this.held = true;
      this.point(event);
    });
    canvas.addEventListener("pointermove", (event) => this.held && this.point(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => this.release());
    canvas.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("hashchange", () => this.openLink());
    element("save").onclick = () => download(FILES.config, configFile(this.choices, this.index, this.whole));
    element("savepath").onclick = () => download(FILES.path, pathFile(this.engine.referencePoints(0.02)));
    element("copy").onclick = () => this.copyLink();
  }

  async copyLink() {
    try {
      await navigator.clipboard.writeText(location.href);
      element("copy").textContent = "Copied";
    } catch {
      this.notice("This browser does not let the page copy: the link is in the address line.");
    }
  }

  point(event) {
    const [x, y] = this.floor.toFloor(event).map((metres) => Math.round(100 * metres) / 100);
    const { reach } = this.index.drawn;
    if (Math.max(Math.abs(x), Math.abs(y)) > reach) return;
    if (this.tool === "carry") this.carry(x, y);
    else if (this.tool === "draw") this.floor.stroke.push([x, y]);
    else this.paint(x, y);
  }

  paint(x, y) {
    const { ice } = this.choices, { radius, most } = this.index.ice;
    const isNear = ice.some((patch) => Math.hypot(patch[0] - x, patch[1] - y) < radius);
    if (!isNear && ice.length < most) this.choose({ ice: [...ice, [x, y]] });
  }

  release() {
    const { stroke } = this.floor;
    this.held = false;
    this.floor.stroke = [];
    if (this.tool !== "draw" || stroke.length < 2) return;
    const step = Math.max(1, (stroke.length - 1) / (this.index.drawn.most_points - 1));
    const drawn = [];
    for (let k = 0; k <= stroke.length - 1 + 1e-9; k += step) drawn.push(stroke[Math.round(k)]);
    this.takeTool("carry");
    this.choose({ drawn });
  }

  key(event) {
    const moves = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, 0.05], ArrowDown: [0, -0.05] };
    const deeds = { " ": () => this.pause(), p: () => this.push(), c: () => this.cover(), r: () => this.restart() };
    const move = moves[event.key];
    if (move) this.carry(this.report.pose[0] + move[0], this.report.pose[1] + move[1]);
    else if (deeds[event.key]) deeds[event.key]();
    else return;
    event.preventDefault();
  }

  /* The clock: as many ticks as time has passed, then a picture. */

  picture(now) {
    const passed = Math.min((now - (this.before ?? now)) / 1000, 0.25);
    this.before = now;
    if (!this.paused) this.drive(passed);
    this.show(now);
    requestAnimationFrame((next) => this.picture(next));
  }

  drive(passed) {
    const isHeld = this.held && this.tool === "carry" ? this.report.pose : null;
    this.owed = Math.min(this.owed + passed, MOST_TICKS * this.period);
    for (; this.owed >= this.period; this.owed -= this.period) {
      if (isHeld) this.engine.c.lab_place(...isHeld);
      this.engine.tick();
      this.report = this.engine.report();
      this.floor.remember(this.report);
      this.charts.remember(this.report);
    }
    if (this.report.has_plan) this.plan = this.engine.plan();
    this.ended = this.report.time > this.report.duration + REST ? this.ended + passed : 0;
    if (this.ended > 0 && this.report.mode >= 2) this.restart();
  }

  show(now) {
    const whole = this.paused && this.whole ? this.whole.poses : null;
    const { ice } = this.choices, { peer } = this;
    this.floor.draw(this.report, this.plan, { whole, ice, peer, held: this.held && this.tool === "carry" });
    this.charts.draw(this.peer);
    this.pictures.push(now);
    while (this.pictures[0] < now - 1000) this.pictures.shift();
    if (now - (this.told ?? 0) < 200) return;
    this.told = now;
    const { report } = this;
    element("error").textContent = millimetres(report.error);
    element("mode").textContent = MODES[report.mode];
    element("step").textContent = `${(1000 * figures(report).step).toFixed(2)} ms`;
    element("rate").textContent = `${this.pictures.length} /s`;
  }
}

function safeDecoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

function download(name, text) {
  const link = made("a", { href: URL.createObjectURL(new Blob([text], { type: "text/plain" })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

(async () => {
  try {
    const [engine, judge] = await openEngines(2);
    window.laboratory = new Laboratory(engine, judge);
    document.documentElement.dataset.ready = "true";
  } catch (error) {
    element("notice").hidden = false;
    element("notice").textContent = `This browser cannot open the laboratory (${error.message}); a newer one can.`;
    throw error;
  }
})();
