/* User interface of the page: controls, pointer and keyboard events, and animation. */

const MODES = ["TRACKING", "REUSED_PLAN", "BRAKING", "STOPPED", "FINISHED"];
/* Causes of a stop by bit of the reasons, see mpc/core/core.h. */
const CAUSES = { 16: "no poses", 64: "too far from the path", 131072: "poses contradict wheels and gyro" };
const LATCHED = 32; /* bit of a robot that stays stopped */
const LIVE_CHOICES = ["dead", "surface", "ice"]; /* choices that take effect during a drive */
const SHARED_CHOICES = ["path", "speed", "drawn", "ice"]; /* choices that both drives of a comparison share */
const TOOLS = { carry: "Carry the robot", ice: "Paint ice", draw: "Draw a path" };
const HINT =
  "A comparison keeps this drive as A. Settings apply to the selected drive; path, speed, ice and buttons to both.";
const MAX_REPORTS = 1500; /* number of reports in the history of a drive */
const MAX_TICKS = 6; /* per animation frame: a slow machine runs slower than real time */
const SLICE = 6; /* computing time of an evaluation between two frames [ms] */
const END_PAUSE = 1.5; /* time between the end of a drive and its repetition [s] */
const element = (id) => document.getElementById(id);

function createNode(tag, properties, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

/* A drive: its settings, its present state with the history, and the evaluation of the complete drive. */
class Drive {
  constructor(engine, side, colour) {
    Object.assign(this, { engine, side, colour });
  }

  setChoices(choices) {
    Object.assign(this, { choices, evaluation: null });
  }

  start(isCovered) {
    const { engine } = this;
    if (!engine.start(this.choices)) return false;
    engine.c.lab_set_cover(isCovered ? 1 : 0);
    Object.assign(this, { report: engine.report(), plan: [], rows: [], cause: "" });
    this.path = engine.referencePoints(0.05).map(([, x, y]) => [x, y]);
    return true;
  }

  tick(isHeld) {
    if (isHeld) this.engine.c.lab_place(...this.report.pose);
    this.engine.tick();
    this.report = this.engine.report();
    this.rows.push(this.report);
    const bit = Object.keys(CAUSES).findLast((candidate) => this.report.reasons & candidate);
    this.cause = MODES[this.report.mode] === "TRACKING" ? "" : CAUSES[bit] ?? this.cause;
    if (this.rows.length > MAX_REPORTS) this.rows.shift();
  }

  /* Mode with the cause of a stop. */
  get state() {
    const remedy = this.report.reasons & LATCHED ? "; press Restart" : "";
    return MODES[this.report.mode] + (this.cause && `: ${this.cause}${remedy}`);
  }

  carry(x, y) {
    const pose = [x, y, this.report.pose[2]];
    this.engine.c.lab_place(...pose);
    this.report = { ...this.report, pose };
  }
}

class Laboratory {
  constructor([a, b, evaluator]) {
    this.drives = { a: new Drive(a, "a", "rival"), b: new Drive(b, "b", "robot") };
    this.evaluator = evaluator; /* engine that computes complete drives */
    this.index = evaluator.index;
    this.period = evaluator.arrays[this.index.robot][0];
    const colours = new Colours();
    this.floor = new FloorView(element("floor"), this.index, colours);
    this.charts = new TimeView(element("charts"), this.index, colours);
    this.reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
    Object.assign(this, { tool: "carry", paused: this.reducedMotion, isCovered: false, isDragging: false, evaluationId: 0 });
    this.createExperimentButtons();
    this.createToolButtons();
    this.createChoiceControls();
    this.addListeners();
    this.openLink();
    requestAnimationFrame((now) => this.animate(now));
  }

  /* Drive that the settings apply to; without a comparison, the only drive. */
  get selectedDrive() { return this.drives[this.side]; }
  get choices() { return this.selectedDrive.choices; }
  get report() { return this.selectedDrive.report; }
  get evaluation() { return this.selectedDrive.evaluation; }
  get activeDrives() { return this.isCompared ? [this.drives.a, this.drives.b] : [this.drives.b]; }

  /* Settings. */

  openLink() {
    const text = safeDecode(location.hash.slice(1)), link = readLink(text, this.index);
    const fault = link.fault || (this.compare(link) ? "" : "its path, speed and limits are not compatible");
    if (fault || !text) this.compare(this.index.experiments[0]);
    this.showNotice(fault && `This link cannot be used, so the first experiment is shown: ${fault}.`);
  }

  /* Set the choices of drive A (null: no comparison) and B, and start them; return false if a drive cannot start. */
  compare({ a, b, side = "b" }) {
    Object.assign(this, { side, isCompared: Boolean(a), isPeerVisible: !a });
    this.drives.a.setChoices({ ...defaultChoices(this.index), ...a });
    this.drives.b.setChoices({ ...defaultChoices(this.index), ...b });
    this.showNotice("");
    return this.restart();
  }

  select(side) {
    this.side = side;
    this.showSettings();
  }

  showNotice(text) {
    element("notice").textContent = text;
    element("notice").hidden = !text;
  }

  /* Change settings of the selected drive, or shared settings; only live choices do not restart the drives. */
  choose(changes) {
    const names = Object.keys(changes), previous = this.activeDrives.map((drive) => drive.choices);
    const drives = names.every((name) => SHARED_CHOICES.includes(name)) ? this.activeDrives : [this.selectedDrive];
    for (const drive of drives) drive.setChoices({ ...drive.choices, ...changes });
    this.showNotice("");
    if (names.every((name) => LIVE_CHOICES.includes(name))) {
      for (const drive of drives) drive.engine.setWorld(drive.choices);
      this.showSettings();
      return;
    }
    if (this.restart()) return;
    this.activeDrives.forEach((drive, i) => drive.setChoices(previous[i]));
    this.restart();
    this.showNotice("This path at this speed exceeds the limits: choose a lower speed or another path.");
  }

  restart() {
    if (!this.activeDrives.every((drive) => drive.start(this.isCovered))) return false;
    this.floor.frame(this.activeDrives.flatMap((drive) => drive.path));
    this.pendingTime = 0;
    this.showSettings();
    return true;
  }

  /* Update link, controls and evaluations after a change of the settings. */
  showSettings() {
    const { index, choices, side } = this, { a, b } = this.drives;
    const [unselected, prefix] = side === "a" ? [b, "b."] : [a, "a."];
    const parts = [linkOf(choices, index), ...(this.isCompared ? [linkOf(unselected.choices, index, prefix)] : [])];
    history.replaceState(null, "", `#${parts.join("&")}`);
    document.body.classList.toggle("compared", this.isCompared);
    element("differs-a").textContent = differences(a.choices, b.choices, index);
    element("differs-b").textContent = differences(b.choices, a.choices, index);
    this.showExperiment();
    this.showChoices();
    element("command").textContent = commandOf(choices);
    element("without-ice").hidden = !choices.ice.length;
    element("savepath").hidden = !needsPathFile(choices);
    this.evaluate(++this.evaluationId);
  }

  /* Compute the complete drives in slices; a newer evaluation cancels this one. */
  async evaluate(id) {
    const { evaluator } = this;
    for (const drive of this.activeDrives.filter(({ evaluation }) => !evaluation)) {
      for (const name of ["rms", "largest"]) element(`${name}-${drive.side}`).textContent = "…";
      if (!evaluator.start(drive.choices)) return;
      const poses = [], ticks = Math.ceil((evaluator.report().duration - 1e-9) / this.period) + 1;
      for (let k = 0; k < ticks; ) {
        const sliceEnd = performance.now() + SLICE;
        for (; k < ticks && performance.now() < sliceEnd; k++) {
          evaluator.tick();
          poses.push(evaluator.report().pose);
        }
        await new Promise((resolve) => setTimeout(resolve));
        if (id !== this.evaluationId) return;
      }
      drive.evaluation = { poses, ...figures(evaluator.report()) };
      for (const name of ["rms", "largest"])
        element(`${name}-${drive.side}`).textContent = millimetres(drive.evaluation[name]);
    }
  }

  /* Controls. */

  createExperimentButtons() {
    for (const experiment of this.index.experiments) {
      element("experiments").append(createNode("button", {
        type: "button", id: `experiment-${experiment.name}`, textContent: experiment.title,
        onclick: () => { this.compare(experiment); this.paused = this.reducedMotion; this.showActions(); },
      }));
    }
  }

  /* Show question and explanation of the experiment that has the present settings, if any. */
  showExperiment() {
    const { a, b } = this.drives, linkOfPair = (pair) => pair.map((choices) => linkOf(choices, this.index)).join("&a&");
    const present = this.isCompared && linkOfPair([a.choices, b.choices]), defaults = defaultChoices(this.index);
    let current = null;
    for (const experiment of this.index.experiments) {
      const isCurrent = linkOfPair(["a", "b"].map((side) => ({ ...defaults, ...experiment[side] }))) === present;
      element(`experiment-${experiment.name}`).ariaPressed = String(isCurrent);
      if (isCurrent) current = experiment;
    }
    element("question").textContent = current ? current.question : this.isCompared ? "Your comparison." : "One drive.";
    element("explanation").textContent = current ? current.see : HINT;
  }

  createToolButtons() {
    for (const [tool, label] of Object.entries(TOOLS))
      element("tools").append(createNode("button", {
        type: "button", id: `tool-${tool}`, role: "radio", textContent: label, onclick: () => this.setTool(tool),
      }));
    const actions = {
      pause: ["Pause", () => this.togglePause()], again: ["Restart", () => this.restart()],
      push: ["Push", () => this.push()], cover: ["Cover the pose sensor", () => this.toggleCover()],
      thaw: ["Remove the ice", () => this.choose({ ice: [] })],
      shipped: ["Remove the drawn path", () => this.choose({ drawn: [] })],
      peer: ["Pure pursuit", () => { this.isPeerVisible = !this.isPeerVisible; this.showActions(); }],
      compare: ["", () => this.compare({ a: this.isCompared ? null : this.choices, b: this.choices })],
    };
    for (const [name, [label, action]] of Object.entries(actions))
      element("actions").append(createNode("button", { type: "button", id: name, textContent: label, onclick: action }));
    for (const side of ["a", "b"]) element(`side-${side}`).onclick = () => this.select(side);
    this.setTool("carry");
  }

  setTool(tool) {
    this.tool = tool;
    for (const name of Object.keys(TOOLS)) element(`tool-${name}`).ariaChecked = String(name === tool);
    element("floor").style.cursor = tool === "carry" ? "grab" : "crosshair";
  }

  showActions() {
    element("pause").textContent = this.paused ? "Drive" : "Pause";
    element("compare").textContent = this.isCompared ? "End the comparison" : "Compare";
    for (const side of ["a", "b"]) element(`side-${side}`).ariaPressed = String(side === this.side);
    element("cover").ariaPressed = String(this.isCovered);
    element("peer").ariaPressed = String(this.isPeerVisible);
    element("thaw").hidden = !this.activeDrives.some(({ choices }) => choices.ice.length);
    element("shipped").hidden = !this.choices.drawn.length;
  }

  createChoiceControls() {
    const groups = new Map();
    for (const [name, choice] of Object.entries(this.index.choices)) {
      if (!groups.has(choice.group)) {
        groups.set(choice.group, createNode("fieldset", {}, createNode("legend", { textContent: choice.group })));
        element("choices").append(groups.get(choice.group));
      }
      const isNumber = choice.values.every((value) => typeof value === "number") && choice.values.length > 2;
      const label = createNode("label", { htmlFor: `choice-${name}`, title: choice.help ?? "" }, choice.label);
      groups.get(choice.group).append(label, ...(isNumber ? this.slider(name, choice) : this.list(name, choice)));
    }
    element("choices").onsubmit = (event) => event.preventDefault();
  }

  list(name, choice) {
    const options = choice.values.map((value) => createNode("option", { value, textContent: value }));
    if (name === "path") options.push(createNode("option", { value: "", textContent: "drawn", hidden: true }));
    const select = createNode("select", { id: `choice-${name}` }, ...options);
    select.onchange = () => {
      const value = choice.values.find((candidate) => String(candidate) === select.value);
      this.choose(name === "path" ? { path: value, drawn: [] } : { [name]: value });
    };
    return [select];
  }

  slider(name, choice) {
    const maxIndex = choice.values.length - 1;
    const input = createNode("input", { type: "range", id: `choice-${name}`, min: 0, max: maxIndex, step: 1 });
    input.oninput = () => this.choose({ [name]: choice.values[Number(input.value)] });
    const number = createNode("input", {
      type: "number", id: `number-${name}`, ariaLabel: choice.label, title: `Possible values: ${possibleValues(choice)}`,
      min: choice.values[0], max: choice.values.at(-1), step: stepOf(choice),
    });
    number.onchange = () => this.chooseNumber(name, choice, number.valueAsNumber);
    return [input, number];
  }

  /* Choose a typed number, or the nearest possible value with a mark and a notice. */
  chooseNumber(name, choice, number) {
    const value = Number.isNaN(number) ? this.choices[name] : nearest(choice, number);
    this.choose({ [name]: value });
    if (value === number || this.choices[name] !== value) return;
    element(`number-${name}`).classList.add("replaced");
    this.showNotice(`${choice.label}: ${value} is used; possible values: ${possibleValues(choice)}.`);
  }

  showChoices() {
    for (const [name, choice] of Object.entries(this.index.choices)) {
      const input = element(`choice-${name}`), value = this.choices[name];
      if (input.type === "range") {
        input.value = choice.values.indexOf(nearest({ values: choice.values }, value));
        input.ariaValueText = element(`number-${name}`).value = String(value);
        element(`number-${name}`).classList.remove("replaced");
      } else input.value = name === "path" && this.choices.drawn.length ? "" : String(value);
    }
    this.showActions();
  }

  /* Disturbances; they act on both drives of a comparison. */

  togglePause() {
    this.paused = !this.paused;
    this.showActions();
  }

  push() {
    const { left, turn, ticks } = this.index.push;
    for (const { engine } of this.activeDrives) engine.c.lab_push(left, turn, ticks);
  }

  toggleCover() {
    this.isCovered = !this.isCovered;
    for (const { engine } of this.activeDrives) engine.c.lab_set_cover(this.isCovered ? 1 : 0);
    this.showActions();
  }

  addListeners() {
    const canvas = element("floor");
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.floor.stroke = [];
      this.isDragging = true;
      this.drag(event);
    });
    canvas.addEventListener("pointermove", (event) => this.isDragging && this.drag(event));
    for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, () => this.endDrag());
    /* Keys act everywhere: after a pointer used a control, the floor view gets the focus back. */
    document.addEventListener("keydown", (event) => { this.isByKey = true; this.handleKey(event); }, true);
    document.addEventListener("pointerdown", () => { this.isByKey = false; }, true);
    for (const type of ["click", "change"])
      document.addEventListener(type, ({ target }) => {
        if (!this.isByKey && target.closest(type === "click" ? "button" : "select, [type=range]"))
          canvas.focus({ preventScroll: true });
      });
    window.addEventListener("hashchange", () => this.openLink());
    element("save").onclick = () => download(FILES.config, configFile(this.choices, this.index, this.evaluation));
    element("savepath").onclick = () => download(FILES.path, pathFile(this.selectedDrive.engine.referencePoints(0.02)));
    element("copy").onclick = () => this.copyLink();
  }

  async copyLink() {
    try {
      await navigator.clipboard.writeText(location.href);
      element("copy").textContent = "Copied";
    } catch {
      this.showNotice("This browser does not allow the page to copy: copy the link from the address bar.");
    }
  }

  /* Apply the selected tool at the pointer. */
  drag(event) {
    const [x, y] = this.floor.toFloor(event).map((metres) => Math.round(100 * metres) / 100);
    const { reach } = this.index.drawn;
    if (Math.max(Math.abs(x), Math.abs(y)) > reach) return;
    if (this.tool === "carry") for (const drive of this.activeDrives) drive.carry(x, y);
    else if (this.tool === "draw") this.floor.stroke.push([x, y]);
    else this.paintIce(x, y);
  }

  paintIce(x, y) {
    const { ice } = this.choices, { radius, most } = this.index.ice;
    const isNear = ice.some((patch) => Math.hypot(patch[0] - x, patch[1] - y) < radius);
    if (!isNear && ice.length < most) this.choose({ ice: [...ice, [x, y]] });
  }

  endDrag() {
    const { stroke } = this.floor;
    this.isDragging = false;
    this.floor.stroke = [];
    if (this.tool !== "draw" || stroke.length < 2) return;
    const step = Math.max(1, (stroke.length - 1) / (this.index.drawn.most_points - 1));
    const drawn = [];
    for (let k = 0; k <= stroke.length - 1 + 1e-9; k += step) drawn.push(stroke[Math.round(k)]);
    this.setTool("carry");
    this.choose({ drawn });
  }

  handleKey(event) {
    const moves = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, 0.05], ArrowDown: [0, -0.05] };
    const actions = {
      " ": () => this.togglePause(), p: () => this.push(), c: () => this.toggleCover(), r: () => this.restart(),
    };
    const { target, key } = event, move = moves[key], action = actions[key.toLowerCase()];
    const isForControl = target.closest(move ? "select, input" : key === " " ? "select, button" : "select");
    if (isForControl || event.ctrlKey || event.altKey || event.metaKey || !(move || action)) return;
    event.preventDefault();
    if (!move) action();
    else for (const drive of this.activeDrives) drive.carry(drive.report.pose[0] + move[0], drive.report.pose[1] + move[1]);
  }

  /* Animation: advance the drives by the elapsed time, then render. */

  animate(now) {
    const elapsed = Math.min((now - (this.previousFrame ?? now)) / 1000, 0.25);
    this.previousFrame = now;
    if (!this.paused) this.advance(elapsed);
    this.render(now);
    requestAnimationFrame((next) => this.animate(next));
  }

  advance(elapsed) {
    const isHeld = this.isDragging && this.tool === "carry", { activeDrives } = this;
    this.pendingTime = Math.min(this.pendingTime + elapsed, MAX_TICKS * this.period);
    for (; this.pendingTime >= this.period; this.pendingTime -= this.period)
      for (const drive of activeDrives) drive.tick(isHeld);
    for (const drive of activeDrives) if (drive.report.has_plan) drive.plan = drive.engine.plan();
    if (activeDrives.every(({ report }) => report.time > report.duration + END_PAUSE && report.mode >= 2)) this.restart();
  }

  render(now) {
    const { isPeerVisible, paused, activeDrives, selectedDrive } = this, isHeld = this.isDragging && this.tool === "carry";
    this.floor.draw(activeDrives, selectedDrive, { isPaused: paused, isPeerVisible, isHeld });
    this.charts.draw(activeDrives, selectedDrive, isPeerVisible);
    if (now - (this.previousUpdate ?? 0) < 200) return;
    this.previousUpdate = now;
    for (const { side, report, state } of activeDrives) {
      element(`error-${side}`).textContent = millimetres(report.error);
      element(`step-${side}`).textContent = `${(1000 * figures(report).step).toFixed(2)} ms`;
      element(`mode-${side}`).textContent = state;
    }
  }
}

function safeDecode(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

function download(name, text) {
  const link = createNode("a", { href: URL.createObjectURL(new Blob([text], { type: "text/plain" })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

(async () => {
  try {
    window.laboratory = new Laboratory(await openEngines(3));
    document.documentElement.dataset.ready = "true";
  } catch (error) {
    element("notice").hidden = false;
    element("notice").textContent = `This browser cannot open the laboratory (${error.message}); use a newer browser.`;
    throw error;
  }
})();
