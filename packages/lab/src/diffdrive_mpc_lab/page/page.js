/* The page itself: controls, the pointer, and the clock. */

const MODES = ["TRACKING", "REUSED_PLAN", "BRAKING", "STOPPED", "FINISHED"];
const LIVE = ["dead", "surface", "ice"]; /* choices that take effect during a drive */
const SHARED = ["path", "speed", "drawn", "ice"]; /* choices of both drives of a comparison */
const TOOLS = { carry: "Carry the robot", ice: "Paint ice", draw: "Draw a path" };
const HINT = "A comparison keeps a drive as A. Settings are those of the marked drive; path, speed, ice and buttons act on both.";
const HISTORY = 1500; /* reports that are kept of each drive */
const MOST_TICKS = 6; /* per picture: a slow machine runs slower than real time */
const SLICE = 6; /* computing time for whole drives between two pictures [ms] */
const REST = 1.5; /* time between the end of a drive and its repetition [s] */
const element = (id) => document.getElementById(id);

function made(kind, properties, ...children) {
  const node = Object.assign(document.createElement(kind), properties);
  node.append(...children);
  return node;
}

/* A drive: its settings, its present state with the history, and the figures of the whole path. */
class Drive {
  constructor(engine, side, colour) {
    Object.assign(this, { engine, side, colour });
  }

  take(choices) {
    Object.assign(this, { choices, whole: null });
  }

  start(isCovered) {
    const { engine } = this;
    if (!engine.start(this.choices)) return false;
    engine.c.lab_set_cover(isCovered ? 1 : 0);
    Object.assign(this, { report: engine.report(), plan: [], rows: [] });
    this.path = engine.referencePoints(0.05).map(([, x, y]) => [x, y]);
    return true;
  }

  tick(isHeld) {
    if (isHeld) this.engine.c.lab_place(...this.report.pose);
    this.engine.tick();
    this.report = this.engine.report();
    this.rows.push(this.report);
    if (this.rows.length > HISTORY) this.rows.shift();
  }

  carry(x, y) {
    const pose = [x, y, this.report.pose[2]];
    this.engine.c.lab_place(...pose);
    this.report = { ...this.report, pose };
  }
}

class Laboratory {
  constructor([a, b, judge]) {
    this.drives = { a: new Drive(a, "a", "rival"), b: new Drive(b, "b", "robot") };
    this.judge = judge; /* drives whole paths for the figures */
    this.index = judge.index;
    this.period = judge.arrays[this.index.robot][0];
    const colours = new Colours();
    this.floor = new FloorView(element("floor"), this.index, colours);
    this.charts = new TimeView(element("charts"), this.index, colours);
    this.calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    Object.assign(this, { tool: "carry", paused: this.calm, covered: false, held: false, job: 0 });
    this.makeExperiments();
    this.makeTools();
    this.makeChoices();
    this.listen();
    this.openLink();
    requestAnimationFrame((now) => this.picture(now));
  }

  /* The marked drive, to which settings belong; without a comparison it is the only one. */
  get marked() { return this.drives[this.side]; }
  get choices() { return this.marked.choices; }
  get report() { return this.marked.report; }
  get whole() { return this.marked.whole; }
  get shown() { return this.isCompared ? [this.drives.a, this.drives.b] : [this.drives.b]; }

  /* Settings. */

  openLink() {
    const text = safeDecoded(location.hash.slice(1)), link = readLink(text, this.index);
    const complaint = link.fault || (this.compare(link) ? "" : "its path, speed and limits do not go together");
    if (complaint || !text) this.compare(this.index.experiments[0]);
    this.notice(complaint && `This link cannot be used, so the first experiment is shown: ${complaint}.`);
  }

  /* Drive A, if it is not null, and B; returns whether both can be driven. */
  compare({ a, b, side = "b" }) {
    Object.assign(this, { side, isCompared: Boolean(a), peer: !a });
    this.drives.a.take({ ...defaultChoices(this.index), ...a });
    this.drives.b.take({ ...defaultChoices(this.index), ...b });
    this.notice("");
    return this.restart();
  }

  mark(side) {
    this.side = side;
    this.settle();
  }

  notice(text) {
    element("notice").textContent = text;
    element("notice").hidden = !text;
  }

  /* Change settings of the marked drive, or of both; a drive continues if only surface or dead time change. */
  choose(changes) {
    const names = Object.keys(changes), before = this.shown.map((drive) => drive.choices);
    const drives = names.every((name) => SHARED.includes(name)) ? this.shown : [this.marked];
    for (const drive of drives) drive.take({ ...drive.choices, ...changes });
    this.notice("");
    if (names.every((name) => LIVE.includes(name))) {
      for (const drive of drives) drive.engine.setWorld(drive.choices);
      this.settle();
      return;
    }
    if (this.restart()) return;
    this.shown.forEach((drive, i) => drive.take(before[i]));
    this.restart();
    this.notice("This path at this speed exceeds the limits: choose a lower speed or another path.");
  }

  restart() {
    if (!this.shown.every((drive) => drive.start(this.covered))) return false;
    this.floor.frame(this.shown.flatMap((drive) => drive.path));
    this.owed = 0;
    this.settle();
    return true;
  }

  /* Show link, controls and figures of the settings. */
  settle() {
    const { index, choices, side } = this, { a, b } = this.drives;
    const [rival, letter] = side === "a" ? [b, "b."] : [a, "a."];
    const words = [linkOf(choices, index), ...(this.isCompared ? [linkOf(rival.choices, index, letter)] : [])];
    history.replaceState(null, "", `#${words.join("&")}`);
    document.body.classList.toggle("compared", this.isCompared);
    element("differs-a").textContent = differences(a.choices, b.choices, index);
    element("differs-b").textContent = differences(b.choices, a.choices, index);
    this.showExperiment();
    this.showChoices();
    element("command").textContent = commandOf(choices);
    element("savepath").hidden = !needsPathFile(choices);
    this.judgeWhole(++this.job);
  }

  /* Drive the whole paths with the third engine, a slice at a time. */
  async judgeWhole(job) {
    const { judge } = this;
    for (const drive of this.shown.filter(({ whole }) => !whole)) {
      for (const name of ["rms", "largest"]) element(`${name}-${drive.side}`).textContent = "…";
      if (!judge.start(drive.choices)) return;
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
      drive.whole = { poses, ...figures(judge.report()) };
      for (const name of ["rms", "largest"])
        element(`${name}-${drive.side}`).textContent = millimetres(drive.whole[name]);
    }
  }

  /* Controls. */

  makeExperiments() {
    for (const experiment of this.index.experiments) {
      element("experiments").append(made("button", {
        type: "button", id: `experiment-${experiment.name}`, textContent: experiment.title,
        onclick: () => { this.compare(experiment); this.paused = this.calm; this.showDeeds(); },
      }));
    }
  }

  /* Say what the experiment shows, if its settings are the present ones. */
  showExperiment() {
    const { a, b } = this.drives, linkOfPair = (pair) => pair.map((choices) => linkOf(choices, this.index)).join("&a&");
    const present = this.isCompared && linkOfPair([a.choices, b.choices]), standard = defaultChoices(this.index);
    let shown = null;
    for (const experiment of this.index.experiments) {
      const isShown = linkOfPair(["a", "b"].map((side) => ({ ...standard, ...experiment[side] }))) === present;
      element(`experiment-${experiment.name}`).ariaPressed = String(isShown);
      if (isShown) shown = experiment;
    }
    element("question").textContent = shown ? shown.question : this.isCompared ? "Your comparison." : "One drive.";
    element("seen").textContent = shown ? shown.see : HINT;
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
      compare: ["", () => this.compare({ a: this.isCompared ? null : this.choices, b: this.choices })],
    };
    for (const [name, [label, deed]] of Object.entries(deeds))
      element("deeds").append(made("button", { type: "button", id: name, textContent: label, onclick: deed }));
    for (const side of ["a", "b"]) element(`side-${side}`).onclick = () => this.mark(side);
    this.takeTool("carry");
  }

  takeTool(tool) {
    this.tool = tool;
    for (const name of Object.keys(TOOLS)) element(`tool-${name}`).ariaChecked = String(name === tool);
    element("floor").style.cursor = tool === "carry" ? "grab" : "crosshair";
  }

  showDeeds() {
    element("pause").textContent = this.paused ? "Drive" : "Pause";
    element("compare").textContent = this.isCompared ? "End the comparison" : "Compare";
    for (const side of ["a", "b"]) element(`side-${side}`).ariaPressed = String(side === this.side);
    element("cover").ariaPressed = String(this.covered);
    element("peer").ariaPressed = String(this.peer);
    element("thaw").hidden = !this.shown.some(({ choices }) => choices.ice.length);
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
      groups.get(choice.group).append(made("label", { htmlFor: `choice-${name}`, title: choice.help ?? "" }, choice.label),
        ...(isNumber ? this.slider(name, choice) : this.list(name, choice)));
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
    return [select];
  }

  slider(name, choice) {
    const last = choice.values.length - 1;
    const input = made("input", { type: "range", id: `choice-${name}`, min: 0, max: last, step: 1 });
    input.oninput = () => this.choose({ [name]: choice.values[Number(input.value)] });
    const number = made("input", { type: "number", id: `number-${name}`, step: "any", ariaLabel: choice.label });
    number.onchange = () => this.type(name, choice, number.valueAsNumber);
    return [input, number];
  }

  /* Take a typed number, or the nearest one that the page has constants for. */
  type(name, choice, wanted) {
    const value = Number.isNaN(wanted) ? this.choices[name] : nearest(choice, wanted);
    this.choose({ [name]: value });
    if (value === wanted || this.choices[name] !== value) return;
    const range = choice.power ? `${choice.values[0]} to ${choice.values.at(-1)}` : choice.values.join(", ");
    this.notice(`${choice.label}: ${value} is used; possible are ${range}.`);
  }

  showChoices() {
    for (const [name, choice] of Object.entries(this.index.choices)) {
      const input = element(`choice-${name}`), value = this.choices[name];
      if (input.type === "range") {
        input.value = choice.values.indexOf(nearest({ values: choice.values }, value));
        input.ariaValueText = element(`number-${name}`).value = String(value);
      } else input.value = name === "path" && this.choices.drawn.length ? "" : String(value);
    }
    this.showDeeds();
  }

  /* Disturbances: they act on both drives of a comparison. */

  pause() {
    this.paused = !this.paused;
    this.showDeeds();
  }

  push() {
    const { left, turn, ticks } = this.index.push;
    for (const { engine } of this.shown) engine.c.lab_push(left, turn, ticks);
  }

  cover() {
    this.covered = !this.covered;
    for (const { engine } of this.shown) engine.c.lab_set_cover(this.covered ? 1 : 0);
    this.showDeeds();
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
    /* Keys act everywhere: a control that a pointer has used gives the focus back to the picture. */
    document.addEventListener("keydown", (event) => { this.byKey = true; this.key(event); }, true);
    document.addEventListener("pointerdown", () => { this.byKey = false; }, true);
    for (const kind of ["click", "change"])
      document.addEventListener(kind, ({ target }) => {
        if (!this.byKey && target.closest(kind === "click" ? "button" : "select, [type=range]"))
          canvas.focus({ preventScroll: true });
      });
    window.addEventListener("hashchange", () => this.openLink());
    element("save").onclick = () => download(FILES.config, configFile(this.choices, this.index, this.whole));
    element("savepath").onclick = () => download(FILES.path, pathFile(this.marked.engine.referencePoints(0.02)));
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
    if (this.tool === "carry") for (const drive of this.shown) drive.carry(x, y);
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
    const { target, key } = event, move = moves[key], deed = deeds[key.toLowerCase()];
    const isTaken = target.closest(move ? "select, input" : key === " " ? "select, button" : "select");
    if (isTaken || event.ctrlKey || event.altKey || event.metaKey || !(move || deed)) return;
    event.preventDefault();
    if (move) for (const drive of this.shown) drive.carry(drive.report.pose[0] + move[0], drive.report.pose[1] + move[1]);
    else deed();
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
    const isHeld = this.held && this.tool === "carry", { shown } = this;
    this.owed = Math.min(this.owed + passed, MOST_TICKS * this.period);
    for (; this.owed >= this.period; this.owed -= this.period) for (const drive of shown) drive.tick(isHeld);
    for (const drive of shown) if (drive.report.has_plan) drive.plan = drive.engine.plan();
    if (shown.every(({ report }) => report.time > report.duration + REST && report.mode >= 2)) this.restart();
  }

  show(now) {
    const { peer, paused, shown } = this, held = this.held && this.tool === "carry";
    this.floor.draw(shown, this.marked, { isPaused: paused, peer, held });
    this.charts.draw(shown, this.marked, peer);
    if (now - (this.refreshed ?? 0) < 200) return;
    this.refreshed = now;
    for (const { side, report } of shown) {
      element(`error-${side}`).textContent = millimetres(report.error);
      element(`step-${side}`).textContent = `${(1000 * figures(report).step).toFixed(2)} ms`;
      element(`mode-${side}`).textContent = MODES[report.mode];
    }
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
    window.laboratory = new Laboratory(await openEngines(3));
    document.documentElement.dataset.ready = "true";
  } catch (error) {
    element("notice").hidden = false;
    element("notice").textContent = `This browser cannot open the laboratory (${error.message}); a newer one can.`;
    throw error;
  }
})();
