/* Pictures: the floor from above, and what happened over time. */

const TRAIL = 1500; /* poses that are kept of each robot */
const SHOWN_SECONDS = 12; /* of the charts */

/* A canvas as sharp as the screen, and the colours of the page. */
function prepared(canvas) {
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
    for (const name of ["text", "muted", "line", "path", "robot", "plan", "estimate", "ghost", "ice", "limit", "card"])
      this[name] = style.getPropertyValue(`--${name}`).trim();
  }
}

class FloorView {
  constructor(canvas, index, colours) {
    Object.assign(this, { canvas, index, colours, path: [], stroke: [] });
    this.clear();
  }

  clear() {
    this.trail = [];
    this.ghostTrail = [];
  }

  /* The frame is that of the path, with room for what happens beside it. */
  frame(points) {
    this.path = points;
    const xs = points.map((point) => point[1]), ys = points.map((point) => point[2]);
    const room = 0.55;
    this.low = [Math.min(...xs) - room, Math.min(...ys) - room];
    this.high = [Math.max(...xs) + room, Math.max(...ys) + room];
  }

  remember(report) {
    for (const [trail, pose] of [[this.trail, report.pose], [this.ghostTrail, report.peer]]) {
      trail.push(pose);
      if (trail.length > TRAIL) trail.shift();
    }
  }

  /* Pixels per metre, and where the origin is. */
  place(width, height) {
    const size = [this.high[0] - this.low[0], this.high[1] - this.low[1]];
    const scale = Math.min(width / size[0], height / size[1]);
    const x = 0.5 * (width - scale * (this.low[0] + this.high[0]));
    const y = 0.5 * (height + scale * (this.low[1] + this.high[1]));
    return { scale, x, y };
  }

  toFloor(event) {
    const box = this.canvas.getBoundingClientRect();
    const { scale, x, y } = this.place(box.width, box.height);
    return [(event.clientX - box.left - x) / scale, (y - (event.clientY - box.top)) / scale];
  }

  draw(report, plan, options) {
    const { pen, width, height } = prepared(this.canvas);
    const { scale, x, y } = this.place(width, height);
    this.pen = pen;
    this.at = ([px, py]) => [x + scale * px, y - scale * py];
    this.scale = scale;
    this.drawFloor(width, height, options);
    this.line(this.path.map((point) => point.slice(1, 3)), this.colours.path, 2, [6, 5]);
    if (options.whole) this.line(options.whole, this.colours.robot, 1, []);
    if (options.peer) this.line(this.ghostTrail, this.colours.ghost, 1.5, []);
    this.line(this.trail, this.colours.robot, 2, []);
    if (this.stroke.length) this.line(this.stroke, this.colours.plan, 3, []);
    if (options.held) this.ring(report.reference, this.index.too_far);
    if (options.peer) this.robot(report.peer, this.colours.ghost, false);
    if (report.has_plan) this.dots(plan);
    this.cross(report.reference);
    this.robot(report.pose, this.colours.robot, true);
    if (report.has_estimate) this.robot(report.estimate, this.colours.estimate, false, [3, 3]);
  }

  drawFloor(width, height, options) {
    const { pen, colours } = this;
    pen.strokeStyle = colours.line;
    pen.lineWidth = 1;
    pen.beginPath();
    const [left, top] = this.at([Math.floor(this.low[0]) - 9, Math.ceil(this.high[1]) + 9]);
    for (let k = 0; k < 40; k++) {
      const across = left + k * this.scale, down = top + k * this.scale;
      pen.moveTo(across, 0);
      pen.lineTo(across, height);
      pen.moveTo(0, down);
      pen.lineTo(width, down);
    }
    pen.stroke();
    pen.fillStyle = colours.ice;
    for (const patch of options.ice) {
      pen.beginPath();
      pen.arc(...this.at(patch), this.index.ice.radius * this.scale, 0, 7);
      pen.fill();
    }
    pen.fillStyle = colours.muted;
    pen.font = "12px sans-serif";
    pen.fillText("squares of 1 m", 8, height - 8);
  }

  line(points, colour, thickness, dashes) {
    const { pen } = this;
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.setLineDash(dashes);
    pen.beginPath();
    points.forEach((point, i) => (i ? pen.lineTo(...this.at(point)) : pen.moveTo(...this.at(point))));
    pen.stroke();
    pen.setLineDash([]);
  }

  dots(plan) {
    const { pen } = this;
    pen.fillStyle = this.colours.plan;
    for (let k = 3; k < plan.length; k += 3) {
      pen.beginPath();
      pen.arc(...this.at([plan[k], plan[k + 1]]), 2.2, 0, 7);
      pen.fill();
    }
  }

  cross(pose) {
    const [x, y] = this.at(pose);
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
    pen.arc(...this.at(pose), radius * this.scale, 0, 7);
    pen.stroke();
  }

  /* The outline of the robot with its front, filled or not. */
  robot(pose, colour, filled, dashes = []) {
    const { pen } = this;
    const [length, width] = this.index.outline.map((metres) => metres * this.scale);
    pen.save();
    pen.translate(...this.at(pose));
    pen.rotate(-pose[2]);
    pen.lineWidth = 1.5;
    pen.setLineDash(dashes);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.beginPath();
    pen.roundRect(-0.5 * length, -0.5 * width, length, width, 3);
    if (filled) {
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

/* Three charts over the last seconds: errors, and commands with their limits. */
class TimeView {
  constructor(canvas, index, colours) {
    Object.assign(this, { canvas, index, colours });
    this.clear();
  }

  clear() {
    this.rows = [];
  }

  remember(report) {
    this.rows.push(report);
    while (this.rows[0].time < report.time - SHOWN_SECONDS) this.rows.shift();
  }

  draw(showPeer) {
    const { pen, width, height } = prepared(this.canvas);
    const { limits } = this.index, third = height / 3;
    const largest = Math.max(20, ...this.rows.map((row) => 1000 * Math.max(row.error, showPeer ? row.peer_error : 0)));
    const error = (row) => 1000 * row.error, peerError = (row) => 1000 * row.peer_error;
    this.chart(pen, width, 0, third, {
      title: showPeer ? "error, mm; pure pursuit: distance from its path" : "error, mm",
      low: 0, high: 1.1 * largest, marks: [0, round(largest)],
      lines: showPeer ? [[peerError, "ghost"], [error, "robot"]] : [[error, "robot"]],
    });
    [["v", "m/s"], ["omega", "rad/s"]].forEach(([name, unit], channel) => {
      const limit = limits[name];
      this.chart(pen, width, (channel + 1) * third, third, {
        title: `${name}, ${unit}: command, motion`,
        low: -1.15 * limit, high: 1.15 * limit, marks: [-limit, 0, limit],
        lines: [[(row) => row.twist[2 * channel], "estimate"], [(row) => row.command[channel], "robot"]],
      });
    });
  }

  chart(pen, width, top, height, { title, low, high, marks, lines }) {
    const left = 46, right = width - 8, bottom = top + height - 8, roof = top + 18;
    const end = this.rows.length ? this.rows.at(-1).time : 0, begin = Math.max(0, end - SHOWN_SECONDS);
    const x = (time) => left + ((right - left) * (time - begin)) / SHOWN_SECONDS;
    const y = (value) => bottom - ((bottom - roof) * (value - low)) / (high - low);
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
    for (const [value, colour] of lines) {
      pen.strokeStyle = this.colours[colour];
      pen.beginPath();
      this.rows.forEach((row, i) => pen[i ? "lineTo" : "moveTo"](x(row.time), y(value(row))));
      pen.stroke();
    }
  }
}

function round(value) {
  return Number(value.toPrecision(2));
}
