"""Logs made worse on purpose, each with a known cause: what must be said about them, and whether they may give a model.

Bases are a small simulated robot and slices of the logs of a Husky and two Warthogs. `FIRST_TEN` were written before
any of their results had been looked at.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from log_parts import BAG_START, bag_topics, drive, write_bag

from diffdrive_mpc.models.pose import integrate_pose

RADIUS, TRACK = 0.15, 0.5
WHEELS = f"wheels: {{radius: {RADIUS}, track: {TRACK}}}\n"
SIMULATED = (
    WHEELS
    + """
columns:
  time: t
  command: {v: v_ref, omega: omega_ref}
  encoders: {left: left, right: right}
  gyro: {yaw_rate: gyro}
  pose: {x: x, y: y, theta: theta}
"""
)
SIDES_ONLY = """
columns:
  time: t
  command: {v: v_ref, omega: omega_ref}
  encoders: {v: v, omega: omega_wheels}
  gyro: {yaw_rate: gyro}
"""
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


def robot(
    seconds=120.0, dt=0.02, seed=0, gain=(1.0, 1.0), lag=0.1, dead_time=0.06, skid=0.6, clip=np.inf, drive=(1, 1)
):
    """Columns of a two-wheeled robot under random steps of a second: two equal lags, a dead time, skid, noise."""
    rng = np.random.default_rng(seed)
    count, hold = round(seconds / dt), round(1.0 / dt)
    levels = rng.uniform([-0.9, -1.6], [0.9, 1.6], (-(-count // hold), 2)) * drive
    levels[rng.random(len(levels)) < 0.15] = 0.0
    command = np.repeat(levels, hold, axis=0)[:count]
    late = round(dead_time / dt)
    taken = np.vstack([np.zeros((late, 2)), command])[:count] * gain
    taken[:, 1] = np.clip(taken[:, 1], -clip, clip)
    first, wheels, pose, keep = np.zeros(2), np.zeros((count, 2)), np.zeros((count, 3)), np.exp(-2 * dt / lag)
    for k in range(1, count):
        first = keep * first + (1 - keep) * taken[k - 1]
        wheels[k] = keep * wheels[k - 1] + (1 - keep) * first
        v, omega = 0.5 * (wheels[k] + wheels[k - 1])
        pose[k] = integrate_pose(pose[k - 1], v, skid * omega, dt)
    side = 0.5 * TRACK * wheels[:, 1]
    noise = rng.normal(0, 1.0, (count, 6))
    return {
        "t": dt * np.arange(count),
        "v_ref": command[:, 0],
        "omega_ref": command[:, 1],
        "left": (wheels[:, 0] - side) / RADIUS + 0.05 * noise[:, 0],
        "right": (wheels[:, 0] + side) / RADIUS + 0.05 * noise[:, 1],
        "gyro": skid * wheels[:, 1] + 0.01 + 0.01 * noise[:, 2],
        "x": pose[:, 0] + 0.002 * noise[:, 3],
        "y": pose[:, 1] + 0.002 * noise[:, 4],
        "theta": (pose[:, 2] + 0.003 * noise[:, 5] + np.pi) % (2 * np.pi) - np.pi,
    }


def real(path, rows):
    """Columns of a slice of a real log."""
    with path.open(encoding="utf-8") as file:
        header = file.readline().strip().split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1 + rows.start, max_rows=rows.stop - rows.start)
    return dict(zip(header, table.T, strict=True))


@dataclass(frozen=True)
class Base:
    """A sound log: its columns, its mapping, and its names of the streams.

    Attributes
    ----------
    commands, wheels, gyro, heading
        Names of columns.
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
        """Columns of "command", "encoders", "gyro" or "pose"."""
        return {
            "command": self.commands,
            "encoders": self.wheels,
            "gyro": (self.gyro,),
            "pose": ("x", "y", self.heading),
        }[name]


BASES = {"simulated": Base(robot, SIMULATED, ("v_ref", "omega_ref"), ("left", "right"), "gyro", "theta", 0.02)}
if "DIFFDRIVE_MPC_DATA" in os.environ:
    _DATA = Path(os.environ["DIFFDRIVE_MPC_DATA"])
    _NAMES = (("cmd_left", "cmd_right"), ("wheel_left", "wheel_right"), "gyro_z", "yaw", 0.05)
    _TERRAINS = _DATA / "norlab_warthog_terrains"
    BASES |= {
        "husky": Base(lambda: real(_DATA / "norlab_husky_tile" / "husky_tile.csv", range(1000, 5000)), HUSKY, *_NAMES),
        "asphalt": Base(lambda: real(_TERRAINS / "warthog_asphalt.csv", range(4800)), WARTHOG, *_NAMES),
        "gravel": Base(lambda: real(_TERRAINS / "warthog_gravel.csv", range(4800)), GRAVEL, *_NAMES),
    }


@dataclass(frozen=True)
class Case:
    """One degraded log.

    Attributes
    ----------
    name
        What was done, in words.
    base
        Of `BASES`.
    change
        (columns, base) -> columns of the degraded log; of several logs, a list.
    kind
        Kinds of finding that name the cause; empty where nothing is wrong.
    says
        What the sentence must hold: the stream and the remedy.
    refused
        Whether no configuration may come of it; None where it may or may not.
    mapping
        (text) -> text of the mapping.
    also
        Kinds that may stand beside: consequences that are true.
    """

    name: str
    base: str
    change: Callable
    kind: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    refused: bool | None = False
    mapping: Callable[[str], str] = str
    also: tuple[str, ...] = ()


def shifted(stream, seconds):
    """The readings of one stream appear `seconds` later in the log, inside each segment."""

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


def scaled(**factors):
    """Columns times a number; keys are streams or names of columns."""

    def change(columns, base):
        result = dict(columns)
        for key, factor in factors.items():
            for name in base.stream(key) if key in ("command", "encoders", "gyro", "pose") else (key,):
                result[name] = columns[name] * factor
        return result

    return change


def swapped(first, second):
    def change(columns, base):
        names = [base.wheels[0], base.wheels[1]] if first == "left" else [first, second]
        return columns | {names[0]: columns[names[1]], names[1]: columns[names[0]]}

    return change


def one_wheel(side, factor):
    """The encoder of one side (0 left, 1 right) times a number."""

    def change(columns, base):
        return columns | {base.wheels[side]: columns[base.wheels[side]] * factor}

    return change


def from_the_middle(stream, factor):
    def change(columns, base):
        later = np.arange(len(columns["x"])) >= len(columns["x"]) // 2
        return columns | {name: np.where(later, factor, 1.0) * columns[name] for name in base.stream(stream)}

    return change


def spikes(names, size, share=0.01, seed=3):
    """Readings here and there are replaced by ones far off."""

    def change(columns, base):
        rng = np.random.default_rng(seed)
        result = dict(columns)
        for name in names:
            hit = rng.random(len(columns[name])) < share
            result[name] = np.where(hit, size * rng.choice([-1.0, 1.0], len(hit)), columns[name])
        return result

    return change


def replaced(**columns):
    """Columns as given by functions of the columns."""
    return lambda before, base: before | {name: make(before) for name, make in columns.items()}


def rows(chosen):
    """Some rows only, or in another order."""

    def change(columns, base):
        keep = chosen(columns)
        return {name: value[keep] for name, value in columns.items()}

    return change


def simulated(**options):
    """Another simulated robot, or another drive of it."""
    return lambda columns, base: robot(**options)


def _shuffled_rows(columns):
    order = np.arange(len(columns["t"]))
    return np.argsort(order + np.random.default_rng(5).uniform(0, 4, len(order)), kind="stable")


def _shuffled_stamps(columns):
    return columns["t"][_shuffled_rows(columns)]


def _bursts(columns, size=10):
    time = columns["t"]
    return time[np.minimum(np.arange(len(time)) // size * size + size - 1, len(time) - 1)] + 1e-4 * (
        np.arange(len(time)) % size
    )


def _counts(name):
    """Running ticks of a wheel speed [rad/s], 4096 a turn."""
    return lambda columns: np.floor(np.cumsum(columns[name] * 0.02) * 4096 / (2 * np.pi))


def _held(name, period):
    return lambda columns: columns[name][np.arange(len(columns[name])) // period * period]


def _rounded(name, quantum):
    return lambda columns: np.round(columns[name] / quantum) * quantum


def _frozen(name, share):
    return lambda columns: np.where(
        np.arange(len(columns[name])) < (1 - share) * len(columns[name]),
        columns[name],
        columns[name][int((1 - share) * len(columns[name]))],
    )


def _holes(columns):
    inside = columns["t"] % 30.0
    return (inside < 20.0) | (inside > 23.0)


def _nan_rows(name):
    return lambda columns: np.where(np.random.default_rng(6).random(len(columns[name])) < 0.02, np.nan, columns[name])


def _four_wheels(dead=None):
    def change(columns, base):
        wheels = {"fl": "left", "fr": "right", "rl": "left", "rr": "right"}
        rng = np.random.default_rng(8)
        noise = {name: rng.normal(0, 0.03, len(columns["t"])) for name in wheels}
        return columns | {
            name: 0.0 * noise[name] if name == dead else columns[of] + noise[name] for name, of in wheels.items()
        }

    return change


def _twist_columns(columns, base):
    left, right = columns["left"], columns["right"]
    return columns | {"v": 0.5 * RADIUS * (left + right), "omega_wheels": RADIUS * (right - left) / TRACK}


_SHIFT = ("time shift",)
_UNIT = ("wrong unit",)
_SIGN = ("wrong sign",)


def _unit(old, new):
    return lambda text: text.replace(old, new)


def _shifts(base, streams=("command", "encoders", "gyro", "pose")):
    return [
        Case(
            f"{base}: {stream} {seconds:+.1f} s",
            base,
            shifted(stream, seconds),
            _SHIFT,
            (stream, "delay"),
            None if stream in ("encoders", "gyro", "pose") else seconds > 0,
        )
        for stream in streams
        for seconds in (0.3, -0.3)
    ]


FIRST_TEN = (
    Case("husky: gyro 0.3 s late", "husky", shifted("gyro", 0.3), _SHIFT, ("gyro", "delay"), None),
    Case("husky: commands 0.3 s late", "husky", shifted("command", 0.3), _SHIFT, ("command", "delay"), True),
    Case("husky: encoders in rpm", "husky", scaled(encoders=60 / (2 * np.pi)), _UNIT, ("encoders", "unit: rpm"), True),
    Case("husky: yaw in degrees", "husky", scaled(yaw=180 / np.pi), _UNIT, ("pose", "unit: deg"), True),
    Case("simulated: milliseconds", "simulated", scaled(t=1000.0), _UNIT, ("time", "unit: ms"), True),
    Case("simulated: right wheel dead", "simulated", one_wheel(1, 0.0), ("dead wheel",), ("right",), True),
    Case("husky: sides swapped", "husky", swapped("left", "right"), ("swapped sides",), ("encoders",), True),
    Case("simulated: y mirrored", "simulated", scaled(y=-1.0), ("mirrored pose",), ("y", "sign: -1"), True),
    Case("simulated: rows shuffled", "simulated", rows(_shuffled_rows), ("shuffled stamps",), ("sort",), True),
    Case(
        "simulated: quantised encoders",
        "simulated",
        replaced(left=_rounded("left", 0.8), right=_rounded("right", 0.8)),
        (),
    ),
)

OTHERS = (
    *(
        Case(f"{base}: as it is", base, lambda columns, base: columns)
        for base in ("simulated", "husky", "asphalt", "gravel")
    ),
    Case("simulated: slow", "simulated", simulated(lag=0.5, seed=11)),
    Case("simulated: much skid", "simulated", simulated(skid=0.35, seed=12)),
    Case("simulated: gain 0.8", "simulated", simulated(gain=(0.8, 1.2), seed=13)),
    Case("simulated: v and omega of the encoders", "simulated", _twist_columns, mapping=lambda _: SIDES_ONLY),
    *_shifts("simulated"),
    *[case for case in _shifts("husky") if case.name not in ("husky: gyro +0.3 s", "husky: command +0.3 s")],
    *_shifts("asphalt", ("command", "gyro")),
    Case(
        "simulated: encoders in rpm",
        "simulated",
        scaled(encoders=60 / (2 * np.pi)),
        _UNIT,
        ("encoders", "unit: rpm"),
        True,
    ),
    Case(
        "asphalt: encoders in rpm", "asphalt", scaled(encoders=60 / (2 * np.pi)), _UNIT, ("encoders", "unit: rpm"), True
    ),
    Case("gravel: rim speeds as rad/s", "gravel", scaled(encoders=0.3), _UNIT, ("encoders", "unit: m/s"), True),
    Case("simulated: yaw in degrees", "simulated", scaled(theta=180 / np.pi), _UNIT, ("pose", "unit: deg"), True),
    Case("husky: gyro in deg/s", "husky", scaled(gyro=180 / np.pi), _UNIT, ("gyro", "unit: deg/s"), True),
    Case("husky: milliseconds", "husky", scaled(t=1000.0), _UNIT, ("time", "unit: ms"), True),
    Case("husky: positions in mm", "husky", scaled(x=1000.0, y=1000.0), _UNIT, ("pose", "unit: mm"), True),
    Case("simulated: positions in cm", "simulated", scaled(x=100.0, y=100.0), _UNIT, ("pose", "unit: cm"), True),
    Case(
        "simulated: running ticks as m/s",
        "simulated",
        replaced(left=_counts("left"), right=_counts("right")),
        ("running counts",),
        ("encoders", "unit: ticks"),
        True,
        _unit("{left: left, right: right}", "{left: {column: left, unit: m/s}, right: {column: right, unit: m/s}}"),
    ),
    Case(
        "simulated: ticks/s as m/s",
        "simulated",
        scaled(encoders=4096 / (2 * np.pi)),
        _UNIT,
        ("encoders", "ticks"),
        True,
        _unit("{left: left, right: right}", "{left: {column: left, unit: m/s}, right: {column: right, unit: m/s}}"),
    ),
    Case("simulated: commands in mm/s", "simulated", scaled(v_ref=1000.0), _UNIT, ("command", "unit: mm/s"), True),
    Case(
        "simulated: commanded deg/s",
        "simulated",
        scaled(omega_ref=180 / np.pi),
        _UNIT,
        ("command", "unit: deg/s"),
        True,
    ),
    Case("husky: left wheel dead", "husky", one_wheel(0, 0.0), ("dead wheel",), ("left",), True),
    Case("asphalt: right wheel dead", "asphalt", one_wheel(1, 0.0), ("dead wheel",), ("right",), True),
    Case("husky: left wheel reversed", "husky", one_wheel(0, -1.0), ("reversed wheel",), ("left", "sign: -1"), True),
    Case(
        "simulated: right wheel reversed",
        "simulated",
        one_wheel(1, -1.0),
        ("reversed wheel",),
        ("right", "sign: -1"),
        True,
    ),
    Case("asphalt: both wheels reversed", "asphalt", scaled(encoders=-1.0), _SIGN, ("encoders", "sign: -1"), True),
    Case("simulated: left wheel twice as fast", "simulated", one_wheel(0, 2.0), ("uneven wheels",), ("left",), True),
    Case("simulated: sides swapped", "simulated", swapped("left", "right"), ("swapped sides",), ("encoders",), True),
    Case("gravel: sides swapped", "gravel", swapped("left", "right"), ("swapped sides",), ("encoders",), True),
    Case(
        "simulated: one wheel of four dead",
        "simulated",
        _four_wheels("rl"),
        ("dead wheel",),
        ("rear_left",),
        True,
        _unit("{left: left, right: right}", "{front_left: fl, front_right: fr, rear_left: rl, rear_right: rr}"),
    ),
    Case(
        "simulated: four sound wheels",
        "simulated",
        _four_wheels(),
        mapping=_unit("{left: left, right: right}", "{front_left: fl, front_right: fr, rear_left: rl, rear_right: rr}"),
    ),
    Case(
        "simulated: left wheel dead, v and omega logged",
        "simulated",
        lambda columns, base: _twist_columns(columns | {"left": 0.0 * columns["left"]}, base),
        ("dead wheel",),
        ("left",),
        True,
        lambda _: SIDES_ONLY,
    ),
    Case("husky: y mirrored", "husky", scaled(y=-1.0), ("mirrored pose",), ("y", "sign: -1"), True),
    Case("husky: yaw clockwise", "husky", scaled(yaw=-1.0), _SIGN, ("pose", "sign: -1"), True),
    Case("simulated: x and y swapped", "simulated", swapped("x", "y"), ("mirrored pose",), ("x", "y"), True),
    Case(
        "simulated: pose frozen",
        "simulated",
        replaced(**{name: _frozen(name, 1.0) for name in ("x", "y", "theta")}),
        ("no response",),
        ("pose",),
        True,
        also=("stuck sensor",),
    ),
    Case(
        "simulated: pose freezes",
        "simulated",
        replaced(**{name: _frozen(name, 0.4) for name in ("x", "y", "theta")}),
        ("stuck sensor",),
        ("pose",),
    ),
    Case("husky: gyro upside down", "husky", scaled(gyro=-1.0), _SIGN, ("gyro", "sign: -1"), True),
    Case("asphalt: gyro upside down", "asphalt", scaled(gyro=-1.0), _SIGN, ("gyro", "sign: -1"), True),
    Case(
        "simulated: gyro constant",
        "simulated",
        replaced(gyro=lambda c: np.full(len(c["t"]), 0.02)),
        ("no response",),
        ("gyro",),
        True,
        also=("stuck sensor",),
    ),
    Case(
        "simulated: gyro noise alone",
        "simulated",
        replaced(gyro=lambda c: np.random.default_rng(4).normal(0, 0.3, len(c["t"]))),
        ("weak response", "no response"),
        ("gyro",),
        True,
    ),
    Case("husky: gyro freezes", "husky", replaced(gyro_z=_frozen("gyro_z", 0.4)), ("stuck sensor",), ("gyro",)),
    Case(
        "two robots",
        "simulated",
        lambda columns, base: [columns, robot(seed=21, gain=(0.6, 1.3), lag=0.3)],
        ("different logs",),
        ("v",),
        None,
    ),
    Case("two drives of one robot", "simulated", lambda columns, base: [columns, robot(seed=22)]),
    Case(
        "husky: two robots",
        "husky",
        lambda columns, base: [columns, scaled(encoders=0.6)(columns, base)],
        ("different logs",),
        ("v",),
        None,
    ),
    Case(
        "simulated: encoders half from the middle on",
        "simulated",
        from_the_middle("encoders", 0.5),
        ("scale change",),
        ("encoders",),
        True,
    ),
    Case(
        "husky: gyro twice from the middle on",
        "husky",
        from_the_middle("gyro", 2.0),
        ("scale change",),
        ("gyro",),
        True,
    ),
    Case(
        "husky: encoders 1.6 times from the middle on",
        "husky",
        from_the_middle("encoders", 1.6),
        ("scale change",),
        ("encoders",),
        True,
    ),
    Case("husky: stamps shuffled", "husky", replaced(t=_shuffled_stamps), ("shuffled stamps",), ("sample_time",), True),
    Case(
        "simulated: stamps in bursts",
        "simulated",
        replaced(t=_bursts),
        ("bursty stamps",),
        ("sample_time: 0.02",),
        None,
    ),
    Case(
        "husky: whole seconds as stamps",
        "husky",
        replaced(t=lambda c: np.floor(c["t"])),
        ("bursty stamps",),
        ("sample_time: 0.05",),
        None,
    ),
    Case(
        "simulated: another clock from the middle on",
        "simulated",
        replaced(t=lambda c: c["t"] + np.where(np.arange(len(c["t"])) < 3000, 0.0, 1.7e9)),
        ("two clocks",),
        ("clock",),
    ),
    Case(
        "asphalt: one step of 6 s",
        "asphalt",
        rows(lambda c: c["calib_step"] == 0),
        ("little excitation", "constant input"),
        ("command",),
        True,
    ),
    Case("simulated: omega never driven", "simulated", simulated(drive=(1, 0)), ("constant input",), ("omega",), True),
    Case("simulated: v never driven", "simulated", simulated(drive=(0, 1)), ("constant input",), ("v was",), True),
    Case(
        "simulated: v and omega in step",
        "simulated",
        lambda columns, base: _in_step(),
        ("little excitation",),
        ("in step",),
        None,
    ),
    Case(
        "simulated: gyro held", "simulated", replaced(gyro=_held("gyro", 4)), ("held readings",), ("gyro", "held: true")
    ),
    Case(
        "simulated: encoders held",
        "simulated",
        replaced(left=_held("left", 3), right=_held("right", 3)),
        ("held readings",),
        ("encoders", "held: true"),
    ),
    Case(
        "simulated: encoders coarse and held",
        "simulated",
        replaced(
            left=lambda c: np.round(_held("left", 4)(c) / 0.4) * 0.4,
            right=lambda c: np.round(_held("right", 4)(c) / 0.4) * 0.4,
        ),
        ("held readings",),
        ("encoders", "held: true"),
    ),
    Case("simulated: NaN rows", "simulated", replaced(left=_nan_rows("left")), ("NaN rows",), ("left",)),
    Case("husky: 1 % spikes of a wheel", "husky", spikes(("wheel_left",), 60.0), ("spikes",), ("encoders",)),
    Case("simulated: 1 % spikes of the gyro", "simulated", spikes(("gyro",), 30.0), ("spikes",), ("gyro",)),
    Case(
        "simulated: 1 % spikes of the encoders",
        "simulated",
        spikes(("left", "right"), 40.0),
        ("spikes",),
        ("encoders",),
    ),
    Case("simulated: poses jump", "simulated", spikes(("x",), 15.0), ("spikes",), ("pose",)),
    Case("simulated: gaps", "simulated", rows(_holes), ("gap",), ("no data",)),
    Case(
        "simulated: gyro empty",
        "simulated",
        replaced(gyro=lambda c: np.full(len(c["t"]), np.nan)),
        ("empty column",),
        ("gyro",),
        True,
    ),
    Case(
        "husky: encoders empty",
        "husky",
        replaced(wheel_left=lambda c: np.full(len(c["t"]), np.nan)),
        ("empty column",),
        ("wheel_left",),
        True,
    ),
    Case("simulated: robot clips omega", "simulated", simulated(clip=0.9, seed=23), ("clipped response",), ("omega",)),
    Case(
        "simulated: commands rest at a limit",
        "simulated",
        lambda columns, base: _smooth_and_clipped(),
        ("saturation",),
        ("limit",),
    ),
)

CASES = tuple(case for case in (*FIRST_TEN, *OTHERS) if case.base in BASES)


def _from_commands(make):
    """The robot's answer to other commands (n, 2) of its time."""
    columns = robot()
    command = make(columns["t"])
    wheels, first, keep = np.zeros_like(command), np.zeros(2), np.exp(-2 * 0.02 / 0.1)
    pose, rng = np.zeros((len(command), 3)), np.random.default_rng(9)
    for k in range(1, len(command)):
        first = keep * first + (1 - keep) * command[max(k - 4, 0)]
        wheels[k] = keep * wheels[k - 1] + (1 - keep) * first
        pose[k] = integrate_pose(pose[k - 1], wheels[k, 0], 0.6 * wheels[k, 1], 0.02)
    side = 0.5 * TRACK * wheels[:, 1]
    noise = rng.normal(0, 1.0, (len(command), 6))
    return columns | {
        "v_ref": command[:, 0],
        "omega_ref": command[:, 1],
        "left": (wheels[:, 0] - side) / RADIUS + 0.05 * noise[:, 0],
        "right": (wheels[:, 0] + side) / RADIUS + 0.05 * noise[:, 1],
        "gyro": 0.6 * wheels[:, 1] + 0.01 * noise[:, 2],
        "x": pose[:, 0] + 0.002 * noise[:, 3],
        "y": pose[:, 1] + 0.002 * noise[:, 4],
        "theta": pose[:, 2] + 0.003 * noise[:, 5],
    }


def _in_step():
    v = robot()["v_ref"]
    return _from_commands(lambda _: np.column_stack([v, 1.5 * v]))


def _smooth_and_clipped():
    return _from_commands(
        lambda t: np.column_stack([np.clip(1.2 * np.sin(0.9 * t), -0.6, 0.6), 1.2 * np.sin(0.55 * t + 1.0)])
    )


def write_columns(path, columns):
    """A CSV file; a column of NaN alone becomes one of empty cells."""
    table = np.column_stack(list(columns.values()))
    empty = np.isnan(table).all(axis=0)
    lines = [
        ",".join("" if e else f"{cell:.12g}" for e, cell in zip(empty, row, strict=True)) for row in table.tolist()
    ]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


def logs_of(case, folder):
    """Files of the degraded log or logs, and the mapping."""
    base = BASES[case.base]
    changed = case.change(base.columns(), base)
    together = changed if isinstance(changed, list) else [changed]
    paths = [write_columns(folder / f"log{i}.csv", columns) for i, columns in enumerate(together)]
    mapping = folder / "map.yaml"
    mapping.write_text(case.mapping(base.mapping))
    return paths, mapping


def bag_with_two_clocks(folder):
    """A bag whose odometry carries the stamps of another clock."""
    topics = bag_topics(drive())
    kind, received, stamped, readings = topics["/odom"]
    topics["/odom"] = (kind, received, stamped - BAG_START + 100.0, readings)
    return write_bag(folder, topics)


def verdict(case, findings, raised=None):
    """ "right", "half", "wrong" or "missed": whether the findings name the cause of the case, and no other.

    Notes name no cause, unless a note is what is asked for.
    """
    named = [finding for finding in findings if finding.kind in case.kind]
    others = [
        finding for finding in findings if finding.severity != "note" and finding.kind not in (*case.kind, *case.also)
    ]
    if raised is not None:
        others = []  # a file that cannot be read says its cause in one line
    if not case.kind:
        return "wrong" if others or raised else "right"
    whole = any(all(word in str(finding) for word in case.says) for finding in named)
    whole |= raised is not None and all(word in raised for word in case.says)
    if whole and not others:
        return "right"
    if named or whole:
        return "half"
    return "wrong" if others or raised else "missed"
