"""Sound logs, made worse elsewhere: a small simulated robot, and slices of the logs of a Husky and two Warthogs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from real_log_files import log_path

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


def poses_of(twist, dt):
    """(n + 1, 3) poses from the origin on, arc by arc, of twists (n, 2) that hold for `dt` each."""
    theta = np.concatenate([[0.0], np.cumsum(twist[:, 1] * dt)])
    headings = np.column_stack([np.zeros((len(twist), 2)), theta[:-1]])
    steps = integrate_pose(headings, twist[:, 0], twist[:, 1], dt)[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), theta])


def robot(
    seconds=120.0,
    dt=0.02,
    seed=0,
    gain=(1.0, 1.0),
    lag=0.1,
    dead_time=0.06,
    skid=0.6,
    clip=np.inf,
    drive=(1, 1),
    radius=RADIUS,
    track=TRACK,
    sag=0.0,
    ramp=np.inf,
    yaw_lag=0.0,
    quantum=0.0,
    command=None,
):
    """Columns of a two-wheeled robot under random steps of a second, or `command` (n, 2): lags, dead time, skid, noise.

    Both gains fall by the share `sag` along the log; each rim changes its speed by at most `ramp` [m/s^2]; the body
    yaws behind its wheels by `yaw_lag` [s]; levels of the commands are multiples of `quantum`.
    """
    rng = np.random.default_rng(seed)
    count, hold = round(seconds / dt), round(1.0 / dt)
    levels = rng.uniform([-0.9, -1.6], [0.9, 1.6], (-(-count // hold), 2)) * drive
    levels[rng.random(len(levels)) < 0.15] = 0.0
    if quantum:
        levels = np.round(levels / quantum) * quantum
    command = np.repeat(levels, hold, axis=0)[:count] if command is None else command
    late = round(dead_time / dt)
    taken = np.vstack([np.zeros((late, 2)), command])[:count] * gain
    taken[:, 1] = np.clip(taken[:, 1], -clip, clip)
    taken *= np.linspace(1.0, 1.0 - sag, count)[:, None]
    if np.isfinite(ramp):
        taken = ramped(taken, ramp * dt, track)
    first, wheels, keep = np.zeros(2), np.zeros((count, 2)), np.exp(-2 * dt / lag)
    for k in range(1, count):
        first = keep * first + (1 - keep) * taken[k - 1]
        wheels[k] = keep * wheels[k - 1] + (1 - keep) * first
    body = wheels * [1.0, skid]
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
    """Values (n, ...) behind one lag [s]."""
    result, keep = np.array(values, dtype=float), np.exp(-dt / lag)
    for k in range(1, len(result)):
        result[k] = keep * result[k - 1] + (1 - keep) * values[k]
    return result


def ramped(twist, step, track):
    """Twists (n, 2) whose rims change by at most `step` [m/s] a row."""
    half = 0.5 * track * twist[:, 1]
    rims = np.column_stack([twist[:, 0] - half, twist[:, 0] + half])
    for k in range(1, len(rims)):
        rims[k] = rims[k - 1] + np.clip(rims[k] - rims[k - 1], -step, step)
    return np.column_stack([rims.mean(axis=1), (rims[:, 1] - rims[:, 0]) / track])


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


_OWN = (("v_ref", "omega_ref"), ("left", "right"), "gyro", "theta", 0.02)
SMALL = {"lag": 0.05, "dead_time": 0.04, "skid": 0.95, "radius": 0.05, "track": 0.3, "gain": (0.97, 1.02), "seed": 31}
HEAVY = {"lag": 0.25, "dead_time": 0.14, "skid": 0.5, "radius": 0.25, "track": 0.8, "gain": (1.05, 0.9), "seed": 32}
BASES = {
    "simulated": Base(robot, SIMULATED, *_OWN),
    "small": Base(lambda: robot(**SMALL), SIMULATED.replace(WHEELS, "wheels: {radius: 0.05, track: 0.3}\n"), *_OWN),
    "heavy": Base(lambda: robot(**HEAVY), SIMULATED.replace(WHEELS, "wheels: {radius: 0.25, track: 0.8}\n"), *_OWN),
}
REAL_NAMES = (("cmd_left", "cmd_right"), ("wheel_left", "wheel_right"), "gyro_z", "yaw", 0.05)
REAL_BASES = {
    "husky": Base(lambda: real(log_path("husky_tile"), range(1000, 5000)), HUSKY, *REAL_NAMES),
    "asphalt": Base(lambda: real(log_path("warthog_asphalt"), range(4800)), WARTHOG, *REAL_NAMES),
    "gravel": Base(lambda: real(log_path("warthog_gravel"), range(4800)), GRAVEL, *REAL_NAMES),
}
BASES |= REAL_BASES


def in_step():
    v = robot()["v_ref"]
    return robot(seed=9, command=np.column_stack([v, 1.5 * v]))


def smooth_and_clipped():
    t = robot()["t"]
    command = np.column_stack([np.clip(1.2 * np.sin(0.9 * t), -0.6, 0.6), 1.2 * np.sin(0.55 * t + 1.0)])
    return robot(seed=9, command=command)
