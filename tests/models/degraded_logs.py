"""Degraded logs for tests: valid base logs, changes that degrade them, and the verdict on the findings.

The base logs are simulated drives and slices of the logs of a Husky and two Warthogs.
"""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from log_parts import MAPPING

from diffdrive_mpc.models.pose import integrate_pose

RADIUS, TRACK = 0.15, 0.5
WHEELS = f"wheels: {{radius: {RADIUS}, track: {TRACK}}}\n"
SIMULATED = WHEELS + MAPPING.replace("{v: v, omega: omega_wheels}", "{left: left, right: right}")
SIDES_ONLY = "".join(line for line in MAPPING.splitlines(keepends=True) if "pose" not in line)
HUSKY = """
wheels: {radius: 0.161827, track: 0.480865}
columns:
  time: t
  segment: segment
  command: {left: cmd_left, right: cmd_right}
  encoders: {left: wheel_left, right: wheel_right, held: true, delay: 0.2}
  gyro: {yaw_rate: gyro_z}
  pose: {x: x, y: y, theta: yaw, held: true, delay: 0.2}
"""
WARTHOG = """
wheels: {radius: 0.3, track: 1.08}
columns:
  sample_time: 0.05
  segment: calib_step
  command: {left: cmd_left, right: cmd_right}
  encoders: {left: wheel_left, right: wheel_right, held: true}
  gyro: {yaw_rate: gyro_z}
"""
GRAVEL = WARTHOG.replace("{yaw_rate: gyro_z}", "{yaw_rate: {column: gyro_z, sign: -1}}")

Columns = dict[str, np.ndarray]


def poses_of(twist, dt):
    """Integrate twists (n, 2), each held for `dt`, to (n + 1, 3) poses from the origin, arc by arc."""
    theta = np.concatenate([[0.0], np.cumsum(twist[:, 1] * dt)])
    headings = np.column_stack([np.zeros((len(twist), 2)), theta[:-1]])
    steps = integrate_pose(headings, twist[:, 0], twist[:, 1], dt)[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), theta])


def robot(
    seconds=120.0,
    seed=0,
    gain=(1.0, 1.0),
    lag=0.1,
    dead_time=0.06,
    skid=0.6,
    drive=(1, 1),
    radius=RADIUS,
    track=TRACK,
    sag=0.0,
    ramp=np.inf,
    yaw_lag=0.0,
    quantum=0.0,
    command=None,
    rolling=1.0,
):
    """Simulate a skidding two-wheeled robot under random steps of one second, or under `command` (n, 2).

    The robot has lags, dead time, skid and noise. Both gains decrease by the fraction `sag` over the log. `ramp`
    [m/s^2] limits the acceleration of each rim. `yaw_lag` [s] is the lag of the yaw rate behind the wheels. Command
    levels are multiples of `quantum`. `rolling` is the ratio of ground speed to rim speed, a scalar or (n, 2) left
    and right.
    """
    rng, dt = np.random.default_rng(seed), 0.02
    count, hold = round(seconds / dt), round(1.0 / dt)
    levels = rng.uniform([-0.9, -1.6], [0.9, 1.6], (-(-count // hold), 2)) * drive
    levels[rng.random(len(levels)) < 0.15] = 0.0
    if quantum:
        levels = np.round(levels / quantum) * quantum
    command = np.repeat(levels, hold, axis=0)[:count] if command is None else command
    delay_rows = round(dead_time / dt)
    inputs = np.vstack([np.zeros((delay_rows, 2)), command])[:count] * gain
    inputs *= np.linspace(1.0, 1.0 - sag, count)[:, None]
    if np.isfinite(ramp):
        inputs = ramped(inputs, ramp * dt, track)
    first_stage, wheels, decay = np.zeros(2), np.zeros((count, 2)), np.exp(-2 * dt / lag)
    for k in range(1, count):
        first_stage = decay * first_stage + (1 - decay) * inputs[k - 1]
        wheels[k] = decay * wheels[k - 1] + (1 - decay) * first_stage
    rims = rolling * (wheels[:, :1] + 0.5 * track * wheels[:, 1:] * [-1.0, 1.0])
    body = np.column_stack([rims.mean(axis=1), skid / track * (rims[:, 1] - rims[:, 0])])
    if yaw_lag:
        body[:, 1] = low_passed(body[:, 1], yaw_lag, dt)
    pose = poses_of(0.5 * (body[1:] + body[:-1]), dt)
    side = 0.5 * track * wheels[:, 1]
    noise = rng.normal(0, 1.0, (count, 6))
    return {
        "t": dt * np.arange(count),
        "v_ref": command[:, 0],
        "omega_ref": command[:, 1],
        "left": (wheels[:, 0] - side) / radius + 0.05 * noise[:, 0],
        "right": (wheels[:, 0] + side) / radius + 0.05 * noise[:, 1],
        "gyro": body[:, 1] + 0.01 + 0.01 * noise[:, 2],
        "x": pose[:, 0] + 0.002 * noise[:, 3],
        "y": pose[:, 1] + 0.002 * noise[:, 4],
        "theta": (pose[:, 2] + 0.003 * noise[:, 5] + np.pi) % (2 * np.pi) - np.pi,
    }


def low_passed(values, lag, dt):
    """Filter values (n, ...) by a first-order lag [s]."""
    result, decay = np.array(values, dtype=float), np.exp(-dt / lag)
    for k in range(1, len(result)):
        result[k] = decay * result[k - 1] + (1 - decay) * values[k]
    return result


def ramped(twist, step, track):
    """Limit the change of the rim speeds of twists (n, 2) to `step` [m/s] per row."""
    half_difference = 0.5 * track * twist[:, 1]
    rims = np.column_stack([twist[:, 0] - half_difference, twist[:, 0] + half_difference])
    for k in range(1, len(rims)):
        rims[k] = rims[k - 1] + np.clip(rims[k] - rims[k - 1], -step, step)
    return np.column_stack([rims.mean(axis=1), (rims[:, 1] - rims[:, 0]) / track])


def read_slice(path, rows):
    """Read a slice of a real log."""
    with path.open(encoding="utf-8") as file:
        header = file.readline().strip().split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1 + rows.start, max_rows=rows.stop - rows.start)
    return dict(zip(header, table.T, strict=True))


@dataclass(frozen=True)
class Base:
    """Valid log with its columns, mapping and column names.

    Attributes
    ----------
    commands, wheels, gyro, heading
        Column names of the streams; `heading` is a column of the pose.
    dt
        Time between two rows [s].
    """

    columns: Callable[[], Columns]
    mapping: str
    commands: tuple[str, ...]
    wheels: tuple[str, str]
    gyro: str
    heading: str
    dt: float

    def stream(self, name):
        """Return the columns of "command", "encoders", "gyro" or "pose", or the column with this name."""
        pose = ("x", "y", self.heading)
        streams = {"command": self.commands, "encoders": self.wheels, "gyro": (self.gyro,), "pose": pose}
        return streams.get(name, (name,))


_NAMES = (("v_ref", "omega_ref"), ("left", "right"), "gyro", "theta", 0.02)
SMALL = {"lag": 0.05, "dead_time": 0.04, "skid": 0.95, "radius": 0.05, "track": 0.3, "gain": (0.97, 1.02), "seed": 31}
HEAVY = {"lag": 0.25, "dead_time": 0.14, "skid": 0.5, "radius": 0.25, "track": 0.8, "gain": (1.05, 0.9), "seed": 32}
BASES = {
    "simulated": Base(robot, SIMULATED, *_NAMES),
    "small": Base(lambda: robot(**SMALL), SIMULATED.replace(WHEELS, "wheels: {radius: 0.05, track: 0.3}\n"), *_NAMES),
    "heavy": Base(lambda: robot(**HEAVY), SIMULATED.replace(WHEELS, "wheels: {radius: 0.25, track: 0.8}\n"), *_NAMES),
}
REAL_NAMES = (("cmd_left", "cmd_right"), ("wheel_left", "wheel_right"), "gyro_z", "yaw", 0.05)
REAL_BASES = {
    "husky": Base(lambda: read_slice(log_path("husky_tile"), range(1000, 5000)), HUSKY, *REAL_NAMES),
    "asphalt": Base(lambda: read_slice(log_path("warthog_asphalt"), range(4800)), WARTHOG, *REAL_NAMES),
    "gravel": Base(lambda: read_slice(log_path("warthog_gravel"), range(4800)), GRAVEL, *REAL_NAMES),
}
BASES |= REAL_BASES


def in_step(columns, base):
    v = columns["v_ref"]
    return robot(seed=9, command=np.column_stack([v, 1.5 * v]))


def around_squares(columns, base):
    """Drive straight and turn in place, mostly to the left, with v and omega of the command exchanged."""
    is_corner, is_left = columns["t"] % 4.0 < 1.5, columns["t"] % 20.0 < 16.0
    command = np.column_stack([0.6 * ~is_corner, np.where(is_left, 1.05, -1.05) * is_corner])
    return swapped("v_ref", "omega_ref")(robot(seed=9, command=command), base)


def smooth_and_clipped(columns, base):
    t = columns["t"]
    command = np.column_stack([np.clip(1.2 * np.sin(0.9 * t), -0.6, 0.6), 1.2 * np.sin(0.55 * t + 1.0)])
    return robot(seed=9, command=command)


@dataclass(frozen=True)
class Case:
    """Degraded log.

    Attributes
    ----------
    base
        Name in `BASES`.
    description
        Description of the change.
    change
        (columns, base) -> columns of the degraded log, or a list for several logs.
    kind
        Kinds of finding that name the cause, separated by "; "; empty for a valid log.
    says
        Expected parts of the finding's text, such as stream and remedy, separated by "; ".
    refused
        True if the log must not result in a configuration; None if both outcomes are correct.
    mapping
        Function that changes the text of the mapping.
    also
        Kind of an additional finding that is a correct consequence of the change.
    """

    base: str
    description: str
    change: Callable
    kind: str = ""
    says: str = ""
    refused: bool | None = False
    mapping: Callable[[str], str] = str
    also: str = ""

    @property
    def name(self) -> str:
        """Base and change."""
        return f"{self.base}: {self.description}"


def shifted(stream, seconds):
    """Delay the readings of one stream by `seconds`, inside each segment."""

    def change(columns, base):
        rows = round(seconds / base.dt)
        segment = columns.get("calib_step" if "sample_time" in base.mapping else "segment", np.zeros(len(columns["x"])))
        result = dict(columns)
        for part in np.split(np.arange(len(segment)), np.flatnonzero(np.diff(segment)) + 1):
            source = np.clip(part - rows, part[0], part[-1])
            for name in base.stream(stream):
                result[name] = np.array(result[name])
                result[name][part] = columns[name][source]
        return result

    return change


def changed(function, *names):
    """Return a change that replaces columns by a function of their values; names are those of streams or columns."""
    return lambda columns, base: (
        columns | {column: function(columns[column]) for name in names for column in base.stream(name)}
    )


def scaled(**factors):
    """Multiply columns by factors; keys are streams or column names."""
    return lambda columns, base: (
        columns | {column: columns[column] * factor for name, factor in factors.items() for column in base.stream(name)}
    )


def swapped(first, second):
    return lambda columns, base: columns | {first: columns[second], second: columns[first]}


def from_the_middle(stream, factor):
    return changed(lambda values: np.where(later(values), factor, 1.0) * values, stream)


def spikes(names, size, share=0.01, seed=3):
    """Replace some readings by outliers."""

    def change(columns, base):
        rng = np.random.default_rng(seed)
        result = dict(columns)
        for name in names:
            is_outlier = rng.random(len(columns[name])) < share
            result[name] = np.where(is_outlier, size * rng.choice([-1.0, 1.0], len(is_outlier)), columns[name])
        return result

    return change


def rows(select):
    """Select or reorder rows."""

    def change(columns, base):
        index = select(columns)
        return {name: value[index] for name, value in columns.items()}

    return change


def simulated(**options):
    """Simulate a different robot, or a different drive of the same robot."""
    return lambda columns, base: robot(**options)


def shuffled(count):
    """Return row numbers out of order."""
    return np.argsort(np.arange(count) + np.random.default_rng(5).uniform(0, 4, count), kind="stable")


def in_bursts(time, size=10):
    rows = np.arange(len(time))
    return time[np.minimum(rows // size * size + size - 1, len(time) - 1)] + 1e-4 * (rows % size)


TICKS = 4096 / (2 * np.pi)
"""Ticks of an encoder per radian."""


def dead_twist(columns, base):
    """Return the columns with v and omega from the encoders, of which the left reads zero."""
    return twist_columns(columns | {"left": 0.0 * columns["left"]}, base)


def with_log(second):
    """Return a change that adds a log: columns, or a change of the first log."""
    return lambda columns, base: [columns, second(columns, base) if callable(second) else second]


def held(period):
    return lambda values: values[np.arange(len(values)) // period * period]


def rounded(quantum):
    return lambda values: np.round(values / quantum) * quantum


def frozen(share):
    """Return a function that repeats a value in the last `share` of the rows."""

    def freeze(values):
        start = (1 - share) * len(values)
        return np.where(np.arange(len(values)) < start, values, values[int(start)])

    return freeze


def constant(value):
    return lambda values: np.full(len(values), value)


def without_some_seconds(columns):
    inside = columns["t"] % 30.0
    return (inside < 20.0) | (inside > 23.0)


def some_nan(values):
    return np.where(np.random.default_rng(6).random(len(values)) < 0.02, np.nan, values)


def noise(values):
    return np.random.default_rng(4).normal(0, 0.3, len(values))


def four_wheels(dead=None):
    def change(columns, base):
        wheels = {"fl": "left", "fr": "right", "rl": "left", "rr": "right"}
        rng = np.random.default_rng(8)
        noise = {name: rng.normal(0, 0.03, len(columns["t"])) for name in wheels}
        return columns | {
            name: 0.0 * noise[name] if name == dead else columns[side] + noise[name] for name, side in wheels.items()
        }

    return change


def twist_columns(columns, base):
    left, right = columns["left"], columns["right"]
    return columns | {"v": 0.5 * RADIUS * (left + right), "omega_wheels": RADIUS * (right - left) / TRACK}


def put(old, new):
    return lambda text: text.replace(old, new)


NO_POSE = put("  pose: {x: x, y: y, theta: theta}\n", "")


def declared(value, *columns):
    """Return a function that declares a unit or a sign of columns in a mapping."""
    names, key = "|".join(columns), "unit" if isinstance(value, str) else "sign"
    return lambda text: re.sub(rf": ({names})([,}}])", rf": {{column: \1, {key}: {value}}}\2", text)


EMPTY = -np.inf
"""Number that represents an empty cell."""


def as_messages(columns, base):
    """Write a row for each message: commands on change, each wheel and the gyro often, poses rarely."""
    is_sent = np.append(True, np.any([np.diff(columns[name]) != 0 for name in base.commands], axis=0))
    every, (left, right) = np.arange(len(is_sent)), base.wheels
    messages = [(base.commands, every[is_sent], 0.0), (("x", "y", base.heading), every[::5], 0.011)]
    messages += [((base.gyro,), every, 0.0), ((left,), every[::2], 0.007), ((right,), every[::2], 0.003)]
    merged = {name: [] for name in columns}
    for names, rows, offset in messages:
        for name, values in columns.items():
            merged[name].append(values[rows] if name in names else np.full(len(rows), EMPTY))
        merged["t"][-1] = columns["t"][rows] + offset
    order = np.argsort(np.concatenate(merged["t"]), kind="stable")
    return {name: np.concatenate(parts)[order] for name, parts in merged.items()}


def write_columns(path, columns):
    """Write a CSV file; the cells of an all-NaN column are empty."""
    table = np.column_stack(list(columns.values()))
    empty = np.isnan(table).all(axis=0) | (table == EMPTY)
    lines = [
        ",".join("" if e else f"{cell:.12g}" for e, cell in zip(*cells, strict=True))
        for cells in zip(empty.tolist(), table.tolist(), strict=True)
    ]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


def logs_of(case, folder):
    """Write the degraded log or logs, and the mapping."""
    base = BASES[case.base]
    degraded = case.change(base.columns(), base)
    logs = degraded if isinstance(degraded, list) else [degraded]
    paths = [write_columns(folder / f"log{i}.csv", columns) for i, columns in enumerate(logs)]
    mapping = folder / "map.yaml"
    mapping.write_text(case.mapping(base.mapping))
    return paths, mapping


def verdict(case, findings, error=None):
    """Compare the findings with the cause of the case; return "right", "half", "wrong" or "missed".

    Notes are ignored unless the case expects a note.
    """
    kinds, fragments = case.kind.split("; "), case.says.split("; ")
    matching = [finding for finding in findings if finding.kind in kinds]
    # For a file that cannot be read, the only text is the error message.
    has_others = error is None and any(
        finding.severity != "note" and finding.kind not in (*kinds, case.also) for finding in findings
    )
    if not case.kind:
        return "wrong" if has_others or error else "right"
    texts = [*map(str, matching), *([] if error is None else [error])]
    is_complete = any(all(fragment in sentence for fragment in fragments) for sentence in texts)
    if is_complete and not has_others:
        return "right"
    if matching or is_complete:
        return "half"
    return "wrong" if has_others or error else "missed"


SIDES = "{left: left, right: right}"
RIMS = "{left: {column: left, unit: m/s}, right: {column: right, unit: m/s}}"
FOUR = "{front_left: fl, front_right: fr, rear_left: rl, rear_right: rr}"
RPM, DEGREES = 60 / (2 * np.pi), 180 / np.pi


def turned(degrees):
    """Return a function that adds an offset [deg] to headings."""
    return lambda heading: (heading + np.radians(degrees) + np.pi) % (2 * np.pi) - np.pi


def clipped(level):
    """Return a function that clips readings at a fraction of their maximum."""
    return lambda values: np.clip(values, *(level * np.nanmax(np.abs(values)) * np.array([-1, 1])))


def both_swapped(columns, base):
    """Swap the sides of encoders and commands."""
    left, right = base.wheels
    result = columns | {left: columns[right], right: columns[left]}
    first, second = base.commands
    if first == "v_ref":
        return result | {second: -columns[second]}
    return result | {first: columns[second], second: columns[first]}


def later(values):
    return np.arange(len(values)) >= len(values) // 2


def order_changes(columns, base):
    """Swap left and right of the encoders in the second half."""
    left, right = (columns[name] for name in base.wheels)
    sides = (np.where(later(left), *pair) for pair in ((right, left), (left, right)))
    return columns | dict(zip(base.wheels, sides, strict=True))


def echoed(rows, radius=None, track=None):
    """Replace the commands by encoder readings delayed by some rows."""

    def change(columns, base):
        left, right = (columns[name] for name in base.wheels)
        if radius is not None:
            left, right = 0.5 * radius * (left + right), radius * (right - left) / track
        delayed_rows = np.clip(np.arange(len(left)) - rows, 0, None)
        return columns | {base.commands[0]: left[delayed_rows], base.commands[1]: right[delayed_rows]}

    return change


def latched(rows):
    """Return a function that samples and holds values at a period of `rows`, from half a period on."""
    first = round(0.5 * rows)
    return lambda values: values[np.clip((np.arange(len(values)) - first) // rows * rows + first, 0, None)]


def circling(twist, seconds, jitter, seed):
    """Drive a circle with the small changes of a tracking controller, starting and stopping in one second."""
    t, rng = 0.02 * np.arange(round(seconds / 0.02)), np.random.default_rng(seed)
    share = np.clip(np.minimum(t, seconds - t), 0.0, 1.0)[:, None]
    command = share * (twist + low_passed(rng.normal(size=(len(t), 2)), 0.02, 0.02) * jitter)
    columns = robot(seed=seed, seconds=seconds, skid=0.9, command=command)
    return columns | {name: columns[name] + rng.normal(0.0, 0.005, len(t)) for name in ("x", "y", "theta")}


def straight(columns, base):
    """Drive straight only; the commanded omega consists of rounding errors."""
    columns = robot(drive=(1, 0), seed=41)
    return columns | {"omega_ref": columns["omega_ref"] + 2.6e-17 * np.random.default_rng(42).normal(size=6000)}


def as_it_is(columns, base):
    return columns


TABLE = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))


def read_cases(group):
    """Read the cases of a group of degraded_logs.yaml."""
    for base, description, change, *options in TABLE[group]:
        kind, says, refused, mapping, also = (*options, *("", "", False, None, "")[len(options) :])
        yield Case(base, description, eval(change), kind, says, refused, eval(mapping) if mapping else str, also)


def with_expo(size):
    """Apply an exponential stick curve to the commands that the robot receives; the log contains the stick."""
    stick = robot()
    command = np.column_stack([stick["v_ref"], stick["omega_ref"]])
    max_command = np.abs(command).max(axis=0)
    columns = robot(command=command * (1 - size + size * (command / max_command) ** 2))
    return columns | {name: stick[name] for name in ("v_ref", "omega_ref")}


def with_zeros(share):
    """Replace a fraction of the commands by zeros of a second publisher, for the robot and in the log."""
    columns = robot()
    is_original = np.random.default_rng(0).random(len(columns["t"])) > share
    return robot(command=np.column_stack([columns["v_ref"], columns["omega_ref"]]) * is_original[:, None])


def flat_tyre(share, side):
    is_flat = np.arange(6000) >= 3000
    return robot(rolling=1.0 - share * is_flat[:, None] * (np.arange(2) == side))


def without_slow_readings(columns, share):
    limit = share * max(np.abs(columns[side]).max() for side in ("left", "right"))
    return columns | {side: np.where(np.abs(columns[side]) < limit, 0.0, columns[side]) for side in ("left", "right")}


FIRST_TEN, VALID, SCALES, TIMES, READINGS, CAUSES, FAULTS = (tuple(read_cases(group)) for group in TABLE)
CASES = (*FIRST_TEN, *VALID, *SCALES, *TIMES, *READINGS, *CAUSES)


# Logs of real robots in the folder DIFFDRIVE_MPC_DATA. Tests that use them have the marker `real_logs`.


FOLDERS = {
    "husky_tile": "norlab_husky_tile",
    "warthog_asphalt": "norlab_warthog_terrains",
    "warthog_gravel": "norlab_warthog_terrains",
}
"""Folder by log name; the mapping of a log has the same name."""


def log_path(name):
    """Return the path of a log; raise KeyError without DIFFDRIVE_MPC_DATA."""
    return Path(os.environ["DIFFDRIVE_MPC_DATA"]) / FOLDERS[name] / f"{name}.csv"
