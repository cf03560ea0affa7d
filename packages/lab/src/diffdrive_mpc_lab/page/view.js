/* Drawings: top view of the floor, and charts over time. */

const CHART_SECONDS = 12; /* duration of the charts [s] */

/* Set a canvas to the resolution of the screen and clear it. */
function prepareCanvas(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

class Colours {
  constructor() {
    this.read();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.read());
  }

  read() {
    const style = getComputedStyle(document.documentElement);
    for (const name of ["text", "muted", "line", "path", "robot", "rival", "plan", "estimate", "ghost", "ice", "limit", "card"])
      this[name] = style.getPropertyValue(`--${name}`).trim();
  }
}

class FloorView {
  constructor(canvas, index, colours) {
    Object.assign(this, { canvas, index, colours, stroke: [] });
  }

  /* Set the visible area: points of the paths with a margin. */
  frame(points) {
    const xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
    const margin = 0.55;
    this.low = [Math.min(...xs) - margin, Math.min(...ys) - margin];
    this.high = [Math.max(...xs) + margin, Math.max(...ys) + margin];
  }

  /* Return pixels per metre, and the position of the origin [pixels]. */
  transform(width, height) {
    const size = [this.high[0] - this.low[0], this.high[1] - this.low[1]];
    const scale = Math.min(width / size[0], height / size[1]);
    const x = 0.5 * (width - scale * (this.low[0] + this.high[0]));
    const y = 0.5 * (height + scale * (this.low[1] + this.high[1]));
    return { scale, x, y };
  }

  toFloor(event) {
    const box = this.canvas.getBoundingClientRect();
    const { scale, x, y } = this.transform(box.width, box.height);
    return [(event.clientX - box.left - x) / scale, (y - (event.clientY - box.top)) / scale];
  }

  /* Draw all drives; pure pursuit, plan and estimate belong to the selected drive. */
  draw(drives, { report, rows, plan }, options) {
    const { pen, width, height } = prepareCanvas(this.canvas), { colours } = this;
    const { scale, x, y } = this.transform(width, height);
    this.pen = pen;
    this.toPixels = ([px, py]) => [x + scale * px, y - scale * py];
    this.scale = scale;
    this.drawFloor(width, height, drives.flatMap((drive) => drive.choices.ice));
    for (const drive of drives) this.line(drive.path, colours.path, 2, [6, 5]);
    if (options.isPaused) for (const drive of drives) this.line(drive.evaluation?.poses ?? [], colours[drive.colour], 1, []);
    if (options.isPeerVisible) this.line(rows.map((row) => row.peer), colours.ghost, 1.5, []);
    for (const drive of drives) this.line(drive.rows.map((row) => row.pose), colours[drive.colour], 2, []);
    if (this.stroke.length) this.line(this.stroke, colours.plan, 3, []);
    if (options.isHeld) this.ring(report.reference, this.index.too_far);
    if (options.isPeerVisible) this.robot(report.peer, colours.ghost, false);
    if (report.has_plan) this.dots(plan);
    this.cross(report.reference);
    for (const drive of drives) this.robot(drive.report.pose, colours[drive.colour], true);
    if (report.has_estimate) this.robot(report.estimate, colours.estimate, false, [3, 3]);
    if (drives.length > 1) for (const drive of drives) this.letter(drive);
  }

  /* Draw the letter of a drive next to its robot. */
  letter({ report, colour, side }) {
    const [x, y] = this.toPixels(report.pose);
    this.pen.fillStyle = this.colours[colour];
    this.pen.font = "bold 15px sans-serif";
    this.pen.fillText(side.toUpperCase(), x + (side === "a" ? -1 : 1) * 0.4 * this.scale - 5, y - 0.3 * this.scale);
  }

  drawFloor(width, height, ice) {
    const { pen, colours } = this;
    pen.strokeStyle = colours.line;
    pen.lineWidth = 1;
    pen.beginPath();
    const [left, top] = this.toPixels([Math.floor(this.low[0]) - 9, Math.ceil(this.high[1]) + 9]);
    for (let k = 0; k < 40; k++) {
      const x = left + k * this.scale, y = top + k * this.scale;
      pen.moveTo(x, 0);
      pen.lineTo(x, height);
      pen.moveTo(0, y);
      pen.lineTo(width, y);
    }
    pen.stroke();
    pen.fillStyle = colours.ice;
    for (const patch of ice) {
      pen.beginPath();
      pen.arc(...this.toPixels(patch), this.index.ice.radius * this.scale, 0, 7);
      pen.fill();
    }
    pen.fillStyle = colours.muted;
    pen.font = "12px sans-serif";
    pen.fillText("grid: 1 m", 8, height - 8);
  }

  line(points, colour, thickness, dashes) {
    const { pen } = this;
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.setLineDash(dashes);
    pen.beginPath();
    points.forEach((point, i) => (i ? pen.lineTo(...this.toPixels(point)) : pen.moveTo(...this.toPixels(point))));
    pen.stroke();
    pen.setLineDash([]);
  }

  dots(plan) {
    const { pen } = this;
    pen.fillStyle = this.colours.plan;
    for (let k = 3; k < plan.length; k += 3) {
      pen.beginPath();
      pen.arc(...this.toPixels([plan[k], plan[k + 1]]), 2.2, 0, 7);
      pen.fill();
    }
  }

  cross(pose) {
    const [x, y] = this.toPixels(pose);
    const { pen } = this;
    pen.strokeStyle = this.colours.text;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x - 6, y);
    pen.lineTo(x + 6, y);
    pen.moveTo(x, y - 6);
    pen.lineTo(x, y + 6);
    pen.stroke();
  }

  ring(pose, radius) {
    const { pen } = this;
    pen.strokeStyle = this.colours.limit;
    pen.lineWidth = 1;
    pen.beginPath();
    pen.arc(...this.toPixels(pose), radius * this.scale, 0, 7);
    pen.stroke();
  }

  /* Draw the outline of the robot with a mark at its front. */
  robot(pose, colour, isFilled, dashes = []) {
    const { pen } = this;
    const [length, width] = this.index.outline.map((metres) => metres * this.scale);
    pen.save();
    pen.translate(...this.toPixels(pose));
    pen.rotate(-pose[2]);
    pen.lineWidth = 1.5;
    pen.setLineDash(dashes);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.beginPath();
    pen.roundRect(-0.5 * length, -0.5 * width, length, width, 3);
    if (isFilled) {
      pen.globalAlpha = 0.35;
      pen.fill();
      pen.globalAlpha = 1;
    }
    pen.stroke();
    pen.beginPath();
    pen.moveTo(0.15 * length, -0.25 * width);
    pen.lineTo(0.4 * length, 0);
    pen.lineTo(0.15 * length, 0.25 * width);
    pen.stroke();
    pen.restore();
  }
}

/* Three charts over the last seconds: error, v and omega with their limits. */
class TimeView {
  constructor(canvas, index, colours) {
    Object.assign(this, { canvas, index, colours });
  }

  /* Draw errors and commands of all drives; pure pursuit and motion belong to the selected drive. */
  draw(drives, selected, isPeerVisible) {
    const { pen, width, height } = prepareCanvas(this.canvas);
    const { limits } = this.index, third = height / 3;
    this.end = Math.max(...drives.map((drive) => drive.report.time));
    const recent = (drive) => drive.rows.filter((row) => row.time >= this.end - CHART_SECONDS);
    const lines = (value) => drives.map((drive) => [recent(drive), value, drive.colour]);
    const errors = lines((row) => 1000 * row.error);
    if (isPeerVisible) errors.unshift([recent(selected), (row) => 1000 * row.peer_error, "ghost"]);
    const maxError = Math.max(20, ...errors.flatMap(([rows, value]) => rows.map(value)));
    this.chart(pen, width, 0, third, {
      title: isPeerVisible ? "error, mm; pure pursuit: distance from its path" : "error, mm",
      low: 0, high: 1.1 * maxError, marks: [0, round(maxError)], lines: errors,
    });
    [["v", "m/s"], ["omega", "rad/s"]].forEach(([name, unit], channel) => {
      const limit = limits[name], motion = (row) => row.twist[2 * channel];
      this.chart(pen, width, (channel + 1) * third, third, {
        title: `${name}, ${unit}: command, motion`,
        low: -1.15 * limit, high: 1.15 * limit, marks: [-limit, 0, limit],
        lines: [[recent(selected), motion, "estimate"], ...lines((row) => row.command[channel])],
      });
    });
  }

  chart(pen, width, top, height, { title, low, high, marks, lines }) {
    const left = 46, right = width - 8, bottom = top + height - 8, plotTop = top + 18;
    const start = Math.max(0, this.end - CHART_SECONDS);
    const x = (time) => left + ((right - left) * (time - start)) / CHART_SECONDS;
    const y = (value) => bottom - ((bottom - plotTop) * (value - low)) / (high - low);
    pen.font = "12px sans-serif";
    pen.fillStyle = this.colours.muted;
    pen.textAlign = "left";
    pen.fillText(title, left, top + 12);
    pen.textAlign = "right";
    pen.lineWidth = 1;
    for (const mark of marks) {
      pen.fillText(String(mark), left - 6, y(mark) + 4);
      pen.strokeStyle = mark && marks.length === 3 ? this.colours.limit : this.colours.line;
      pen.beginPath();
      pen.moveTo(left, y(mark));
      pen.lineTo(right, y(mark));
      pen.stroke();
    }
    pen.lineWidth = 1.8;
    for (const [rows, value, colour] of lines) {
      pen.strokeStyle = this.colours[colour];
      pen.beginPath();
      rows.forEach((row, i) => pen[i ? "lineTo" : "moveTo"](x(row.time), y(value(row))));
      pen.stroke();
    }
  }
}

function round(value) {
  return Number(value.toPrecision(2));
}
