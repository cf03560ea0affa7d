"""One drive with the monitor behind its controller, and the result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from studies.monitor.faults import AT_START, FAULTS, Fault, Sent

from diffdrive_mpc.bench.case import NO_MODEL, Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.models.logs.drive_log.topics import path_times
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc_monitor.judge import Judge, MonitorVerdict
from diffdrive_mpc_monitor.rules import Rules

BASE_TIMEOUT = 0.5
"""Time after the last command at which the base stops by itself [s], as in `sim/ros/base.yaml`."""
_STANDING = frozenset({"STOPPED", "FINISHED", "PAUSED", "IDLE"})
"""Modes in which a controller reports that it does not drive."""
_TOLD_AGAIN = 0.2
"""Shift of the reference in time at which the node sends it again [s]."""
_BEFORE = 1000.0
"""The clock at time 0 [s]: a stamp of 0 means "none", as in ROS."""


class WatchedStep(NamedTuple):
    """Result of a tick as in `models.interface.ControlStep`: the command is that of the monitor."""

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = math.nan
    solver: None = None
    plan: FloatArray | None = None


class MonitoredController:
    """Drives with `inner`, whose commands go through the monitor; satisfies `models.interface.TrackingController`.

    Parameters
    ----------
    inner
        Controller of the robot.
    rules
        Rules of the monitor.
    fault
        Fault of the drive; None without one.
    """

    def __init__(self, inner: TrackingController, rules: Rules, fault: Fault | None = None) -> None:
        self._inner, self._rules, self._fault = inner, rules, fault or Fault()

    @property
    def verdict(self) -> MonitorVerdict:
        """Return the verdict that stopped the robot, on the clock of the plant; empty if all is well."""
        verdict = self._judge.verdict
        return verdict._replace(at=verdict.at - _BEFORE) if verdict else verdict

    def start(self, reference: Reference, t0: float) -> None:
        """Start to track; publish the reference to the monitor as the node does."""
        self._fault.start(reference)
        self._inner.start(self._fault.followed(reference), t0)
        self._judge = Judge(self._rules, t0 + _BEFORE)
        self._reference, self._t0 = reference, t0
        self._tell_reference(t0, 0.0)
        self._summed, self._summed_at = reference.sample([0.0]).pose[0].tolist(), t0
        self._base, self._base_at = (0.0, 0.0), t0

    def step(self, t: float, measurement: Measurement) -> WatchedStep:
        """Decide, judge, and pass on."""
        fault, now = self._fault, t + _BEFORE
        broken = fault.active(t)
        measurement = fault.measures(measurement) if broken else measurement
        self._tell(t, measurement)
        step: ControlStep = self._inner.step(t, fault.sees(measurement) if broken else measurement)
        command, mode = Sent(t, float(step.command[0]), float(step.command[1])), str(step.mode)
        sent = fault.sends(command) if broken else [command]
        fault.went(sent)
        planned = getattr(self._inner, "planned_delay", 0.0)
        if mode not in _STANDING and abs(planned - self._planned) >= _TOLD_AGAIN:
            self._tell_reference(t, planned)
        self._judge.says(now, drives=(fault.says(mode) if broken else mode) not in _STANDING)
        for sent_command in sent:
            self._base, self._base_at = (
                self._judge.command(now, sent_command.stamp + _BEFORE, sent_command.v, sent_command.omega),
                t,
            )
        stopped = self._judge.tick(now)
        if stopped is not None:
            self._base, self._base_at = stopped, t
        if t - self._base_at > BASE_TIMEOUT:
            self._base = (0.0, 0.0)
        driven = fault.obeys(self._base) if broken else self._base
        return WatchedStep(np.array(driven), mode, step.message, step.step_time)

    def _tell_reference(self, t: float, delay: float) -> None:
        """Pass the reference, delayed by `delay` [s], to the judge."""
        times = path_times(self._reference.duration)
        points = np.column_stack([times + self._t0 + delay + _BEFORE, self._reference.sample(times).pose])
        self._judge.reference(t + _BEFORE, self._fault.published(points).tolist())
        self._planned = delay

    def _tell(self, t: float, measurement: Measurement) -> None:
        """Pass the data of base and sensors, as on their topics."""
        now, judge = t + _BEFORE, self._judge
        if measurement.yaw_rate is not None:
            judge.gyro(now, measurement.yaw_rate.time + _BEFORE, float(np.asarray(measurement.yaw_rate.value)))
        if measurement.wheel_twist is not None:
            twist = np.asarray(measurement.wheel_twist.value).tolist()
            self._sum_up(measurement.wheel_twist.time, *twist)
            judge.odometry(now, measurement.wheel_twist.time + _BEFORE, twist, self._summed)
        if measurement.pose is not None:
            judge.pose(now, measurement.pose.time + _BEFORE, np.asarray(measurement.pose.value).tolist())

    def _sum_up(self, time: float, v: float, omega: float) -> None:
        """Carry on the pose of the odometry."""
        step, self._summed_at = time - self._summed_at, time
        x, y, theta = self._summed
        middle = theta + 0.5 * step * omega
        self._summed = [x + step * v * math.cos(middle), y + step * v * math.sin(middle), theta + step * omega]


# Drives without a fault: drawn from controllers, paths, floors, scenarios, and sensors.


CONTROLLERS = (
    *(("mpc", model) for model in ("ssm", "ssm", "sm", "mbm", "kinematic")),
    *((peer, NO_MODEL) for peer in ("pursuit+slip", "kanayama+slip", "lqr+slip")),
)
"""Each with its model; the SSM drives twice as often."""
PREDICTIVE = tuple(pair for pair in CONTROLLERS if pair[0] == "mpc")
THROWN_OFF = frozenset({"push", "start_offset"})
"""Here only the MPC drives: a plain law that is thrown off a fast path is half a metre away before it is back, which is
no sound drive (two alarms in 276 drives from seed 10000 on were of these, and right)."""
PATHS = ("circle", "square", "s", "cane", "figure8", "fast_circle", "slalom", "reverse_slalom", "k_turn", "spiral")
SPLINES = 40
"""Number of additional random paths."""
_FLOORS = ("default", "default", "carpet", "deep_carpet", "grippy", "slippery")
_HAPPENINGS = ("push", "patches", "payload", "slope", "start_offset")
PLACES = (*((floor, "none") for floor in _FLOORS), *(("default", happening) for happening in _HAPPENINGS))
"""Floors and scenarios."""
SENSORS = (
    *("default", "default", "slam", "noise_2cm", "poses_100ms"),
    *("poses_20hz", "poses_10hz", "poses_5hz", "poses_2hz"),
)


def nominal_case(seed: int) -> Case:
    """Build the drive of a seed."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1971,)))

    def one_of(values: tuple[Any, ...]) -> Any:  # noqa: ANN401 - of what is given
        return values[int(draw.integers(len(values)))]

    controller, model = one_of(CONTROLLERS)
    surface, scenario = one_of(PLACES)
    if scenario in THROWN_OFF:
        controller, model = one_of(PREDICTIVE)
    trajectory = one_of((*PATHS, *(f"spline-{k}" for k in range(SPLINES // 4))))
    if trajectory.startswith("spline-"):
        trajectory = f"spline-{int(draw.integers(SPLINES))}"
    return Case(
        controller=controller,
        model=model,
        trajectory=trajectory,
        surface=surface,
        scenario=scenario,
        sensors=one_of(SENSORS),
        seed=seed,
    )


FAULTY_PATHS = ("s", "square", "cane", "figure8", "slalom", "spline-0", "spline-1", "spline-2")
"""Paths that faulty controllers drive: they bend, or continuing as before would be right."""
AFTER, _AFTER_FAULT = 3.0, 8.0
"""Time that a drive continues after the end of its reference [s]."""
_FIRST, _LAST = 2.5, 5.0
"""A fault begins between these [s]."""
HARM = 1.0
"""A robot does harm that comes so far from the stretch of path around its reference [m], or cannot be stopped."""
_AT_REST = 0.05
"""A slower robot counts as standing [m/s, rad/s]."""
_NEAR = (6.0, 1.0)
"""Harm is measured to the part of the reference from this time ago to this time ahead [s]."""


@dataclass(frozen=True)
class MonitorTrial:
    """Result of one drive.

    Attributes
    ----------
    case
        Case of the drive.
    fault
        Name of the fault; empty without one.
    driven
        Duration of the drive [s].
    rule, words
        Rule and words of the verdict; empty without one.
    after
        From the fault, or else the start, to the verdict [s]; NaN without one.
    farthest
        From the stretch of path around the reference, of the true pose, until the robot stands for good [m].
    fastest
        True speed meanwhile [m/s].
    at_rest
        Whether the robot stands at the end.
    left
        Whether it leaves the stretch around its reference (`LEFT`, `ON_TIME`) without fault and monitor, too: an alarm
        is then no false one. Without an alarm: whether it did.
    """

    case: Case
    fault: str
    driven: float
    rule: str
    words: str
    after: float
    farthest: float
    fastest: float
    at_rest: bool
    left: bool


def nominal_trial(seed: int, rules: Rules) -> MonitorTrial:
    """Run a drive without a fault."""
    return _drive(nominal_case(seed), "", 0.0, rules)


def faulty_trial(fault: str, seed: int, rules: Rules) -> MonitorTrial:
    """Run a drive of the MPC with a fault; path and time are drawn."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1972,)))
    path = FAULTY_PATHS[int(draw.integers(len(FAULTY_PATHS)))]
    begins = 0.0 if fault in AT_START else float(draw.uniform(_FIRST, _LAST))
    controller = FAULTS[fault].controller
    model = Case().model if controller == "mpc" else NO_MODEL
    return _drive(Case(controller=controller, model=model, trajectory=path, seed=seed), fault, begins, rules)


def _drive(case: Case, fault: str, begins: float, rules: Rules) -> MonitorTrial:
    controller, plant, reference = build(case)
    broken = FAULTS[fault].make(begins) if fault else Fault()
    watched = MonitoredController(controller, rules, broken)
    run = simulate(watched, plant, reference, extra_time=_AFTER_FAULT if fault else AFTER)
    verdict = watched.verdict
    since = next((float(t) for t in run.time if broken.active(float(t))), 0.0) if fault else 0.0
    after = (run.time >= since) & ~_rests_for_good(run)
    return MonitorTrial(
        case=case,
        fault=fault,
        driven=float(run.time[-1]),
        rule=verdict.rule,
        words=verdict.words,
        after=verdict.at - since if verdict else math.nan,
        farthest=float(distances(run)[after].max(initial=0.0)),
        fastest=float(np.abs(run.true_twist[after, 0]).max(initial=0.0)),
        at_rest=bool(_rests_for_good(run)[-25:].all()),
        left=_largest_distance(run if not verdict else simulate(*build(case), extra_time=AFTER)) > LEFT,
    )


def _rests_for_good(run: Run) -> NDArray[np.bool_]:
    """Return (n,) True from the time on at which the robot stands for good; the reference may move on."""
    moves = np.abs(run.true_twist[:, [0, 2]]).max(axis=1) > _AT_REST
    return ~np.logical_or.accumulate(moves[::-1])[::-1]


def distances(run: Run, near: tuple[float, float] = _NEAR) -> FloatArray:
    """Compute distances (n,) of the true position from the reference between `near[0]` ago and `near[1]` ahead [m]."""
    times = np.arange(-near[0], run.time[-1] + near[1], 0.05)
    places = run.reference.sample(times).pose[:, :2]
    first = np.searchsorted(times, run.time - near[0])
    last = np.searchsorted(times, run.time + near[1], "right")
    poses = run.true_pose[:, :2]
    away = [np.hypot(*(places[a:b] - pose).T).min() for a, b, pose in zip(first, last, poses, strict=True)]
    return np.array(away)


LEFT = 0.1
"""Distance beyond which the robot has left the stretch that its reference covers around now [m]."""
ON_TIME = 0.5
"""Time by which this stretch begins before now and ends after now [s]."""


def _largest_distance(run: Run) -> float:
    """Compute the maximum distance from the stretch around the reference at each time [m]."""
    return float(distances(run, (ON_TIME, ON_TIME)).max())
