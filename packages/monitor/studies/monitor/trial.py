"""Simulated drive with the monitor between controller and base, and its result."""

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
"""Timeout of the base after the last command [s], as in `sim/ros/base.yaml`."""
_STANDING = frozenset({"STOPPED", "FINISHED", "PAUSED", "IDLE"})
"""Modes in which a controller reports that it does not drive."""
_MIN_SHIFT = 0.2
"""Shift of the reference in time from which the node publishes it again [s]."""
_CLOCK_OFFSET = 1000.0
"""Clock at time 0 [s], because a stamp of 0 means "no stamp" in ROS."""


class MonitoredStep(NamedTuple):
    """Result of a tick as in `models.interface.ControlStep`, with the command of the monitor."""

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = math.nan
    solver: None = None
    plan: FloatArray | None = None


class MonitoredController:
    """Controller whose commands pass through the monitor; implements `models.interface.TrackingController`.

    Parameters
    ----------
    inner
        Controller of the robot.
    rules
        Rules of the monitor.
    fault
        Fault of the drive; None for no fault.
    """

    def __init__(self, inner: TrackingController, rules: Rules, fault: Fault | None = None) -> None:
        self._inner, self._rules, self._fault = inner, rules, fault or Fault()

    @property
    def verdict(self) -> MonitorVerdict:
        """Verdict that stopped the robot, on the clock of the plant; empty if no rule is violated."""
        verdict = self._judge.verdict
        return verdict._replace(at=verdict.at - _CLOCK_OFFSET) if verdict else verdict

    def start(self, reference: Reference, t0: float) -> None:
        """Start to track, and publish the reference to the monitor."""
        self._fault.start(reference)
        self._inner.start(self._fault.followed(reference), t0)
        self._judge = Judge(self._rules, t0 + _CLOCK_OFFSET)
        self._reference, self._t0 = reference, t0
        self._publish_reference(t0, 0.0)
        self._odometry_pose, self._odometry_time = reference.sample([0.0]).pose[0].tolist(), t0
        self._base, self._base_at = (0.0, 0.0), t0

    def step(self, t: float, measurement: Measurement) -> MonitoredStep:
        """Step the controller, check its commands, and return the command of the monitor."""
        fault, now = self._fault, t + _CLOCK_OFFSET
        is_faulty = fault.active(t)
        measurement = fault.measures(measurement) if is_faulty else measurement
        self._publish_sensors(t, measurement)
        step: ControlStep = self._inner.step(t, fault.sees(measurement) if is_faulty else measurement)
        command, mode = Sent(t, float(step.command[0]), float(step.command[1])), str(step.mode)
        sent = fault.sends(command) if is_faulty else [command]
        fault.record(sent)
        planned = getattr(self._inner, "planned_delay", 0.0)
        if mode not in _STANDING and abs(planned - self._planned) >= _MIN_SHIFT:
            self._publish_reference(t, planned)
        self._judge.says(now, drives=(fault.says(mode) if is_faulty else mode) not in _STANDING)
        for sent_command in sent:
            self._base, self._base_at = (
                self._judge.command(now, sent_command.stamp + _CLOCK_OFFSET, sent_command.v, sent_command.omega),
                t,
            )
        stopped = self._judge.tick(now)
        if stopped is not None:
            self._base, self._base_at = stopped, t
        if t - self._base_at > BASE_TIMEOUT:
            self._base = (0.0, 0.0)
        executed = fault.obeys(self._base) if is_faulty else self._base
        return MonitoredStep(np.array(executed), mode, step.message, step.step_time)

    def _publish_reference(self, t: float, delay: float) -> None:
        """Publish the reference, delayed by `delay` [s], to the judge."""
        times = path_times(self._reference.duration)
        points = np.column_stack([times + self._t0 + delay + _CLOCK_OFFSET, self._reference.sample(times).pose])
        self._judge.reference(t + _CLOCK_OFFSET, self._fault.published(points).tolist())
        self._planned = delay

    def _publish_sensors(self, t: float, measurement: Measurement) -> None:
        """Publish the data of base and sensors to the judge."""
        now, judge = t + _CLOCK_OFFSET, self._judge
        if measurement.yaw_rate is not None:
            judge.gyro(now, measurement.yaw_rate.time + _CLOCK_OFFSET, float(np.asarray(measurement.yaw_rate.value)))
        if measurement.wheel_twist is not None:
            twist = np.asarray(measurement.wheel_twist.value).tolist()
            self._integrate_odometry(measurement.wheel_twist.time, *twist)
            judge.odometry(now, measurement.wheel_twist.time + _CLOCK_OFFSET, twist, self._odometry_pose)
        if measurement.pose is not None:
            judge.pose(now, measurement.pose.time + _CLOCK_OFFSET, np.asarray(measurement.pose.value).tolist())

    def _integrate_odometry(self, time: float, v: float, omega: float) -> None:
        """Integrate the pose of the odometry."""
        step, self._odometry_time = time - self._odometry_time, time
        x, y, theta = self._odometry_pose
        middle = theta + 0.5 * step * omega
        self._odometry_pose = [x + step * v * math.cos(middle), y + step * v * math.sin(middle), theta + step * omega]


# Drives without a fault, drawn from controllers, paths, surfaces, scenarios, and sensors.


CONTROLLERS = (
    *(("mpc", model) for model in ("ssm", "ssm", "sm", "mbm", "kinematic")),
    *((peer, NO_MODEL) for peer in ("pursuit+slip", "kanayama+slip", "lqr+slip")),
)
"""Controllers with their models; the SSM has twice the weight."""
PREDICTIVE = tuple(pair for pair in CONTROLLERS if pair[0] == "mpc")
DISTURBED = frozenset({"push", "start_offset"})
"""Scenarios that use only the MPC: after such a disturbance on a fast path, the other control laws deviate by half a
metre (two correct alarms in 276 drives from seed 10000 on)."""
PATHS = ("circle", "square", "s", "cane", "figure8", "fast_circle", "slalom", "reverse_slalom", "k_turn", "spiral")
SPLINES = 40
"""Number of additional random paths."""
_SURFACES = ("default", "default", "carpet", "deep_carpet", "grippy", "slippery")
_DISTURBANCES = ("push", "patches", "payload", "slope", "start_offset")
ENVIRONMENTS = (*((floor, "none") for floor in _SURFACES), *(("default", happening) for happening in _DISTURBANCES))
"""Pairs of surface and scenario."""
SENSORS = (
    *("default", "default", "slam", "noise_2cm", "poses_100ms"),
    *("poses_20hz", "poses_10hz", "poses_5hz", "poses_2hz"),
)


def nominal_case(seed: int) -> Case:
    """Build the drive of a seed."""
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1971,)))

    def one_of(values: tuple[Any, ...]) -> Any:  # noqa: ANN401 - any value
        return values[int(draw.integers(len(values)))]

    controller, model = one_of(CONTROLLERS)
    surface, scenario = one_of(ENVIRONMENTS)
    if scenario in DISTURBED:
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
"""Paths for faulty controllers; they are curved, so that a constant command is wrong."""
AFTER, _AFTER_FAULT = 3.0, 8.0
"""Time that a drive continues after the end of its reference [s]."""
_FIRST, _LAST = 2.5, 5.0
"""Range of the start time of a fault [s]."""
HARM = 1.0
"""Distance from the path section around the reference that counts as harm [m]."""
_AT_REST = 0.05
"""Speed below which a robot counts as standing [m/s, rad/s]."""
_NEAR = (6.0, 1.0)
"""Time before and after the present that defines the path section for harm [s]."""


@dataclass(frozen=True)
class MonitorTrial:
    """Result of one drive.

    Attributes
    ----------
    case
        Case of the drive.
    fault
        Name of the fault; empty for none.
    driven
        Duration of the drive [s].
    rule, words
        Rule and description of the verdict; empty for none.
    after
        Time from the fault, or from the start, to the verdict [s]; NaN if there is no verdict.
    farthest
        Maximum distance of the true pose from the path section around the reference, until the final standstill [m].
    fastest
        Maximum true speed until the final standstill [m/s].
    at_rest
        True if the robot stands at the end.
    left
        True if the robot leaves the path section around its reference (`LEFT`, `ON_TIME`). After an alarm, this is
        checked in a drive without fault and monitor: the alarm is false if the robot does not leave the section.
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
    start = 0.0 if fault in AT_START else float(draw.uniform(_FIRST, _LAST))
    controller = FAULTS[fault].controller
    model = Case().model if controller == "mpc" else NO_MODEL
    return _drive(Case(controller=controller, model=model, trajectory=path, seed=seed), fault, start, rules)


def _drive(case: Case, fault: str, start: float, rules: Rules) -> MonitorTrial:
    controller, plant, reference = build(case)
    active_fault = FAULTS[fault].make(start) if fault else Fault()
    monitored = MonitoredController(controller, rules, active_fault)
    run = simulate(monitored, plant, reference, extra_time=_AFTER_FAULT if fault else AFTER)
    verdict = monitored.verdict
    since = next((float(t) for t in run.time if active_fault.active(float(t))), 0.0) if fault else 0.0
    after = (run.time >= since) & ~_is_finally_at_rest(run)
    return MonitorTrial(
        case=case,
        fault=fault,
        driven=float(run.time[-1]),
        rule=verdict.rule,
        words=verdict.words,
        after=verdict.at - since if verdict else math.nan,
        farthest=float(distances(run)[after].max(initial=0.0)),
        fastest=float(np.abs(run.true_twist[after, 0]).max(initial=0.0)),
        at_rest=bool(_is_finally_at_rest(run)[-25:].all()),
        left=_max_distance(run if not verdict else simulate(*build(case), extra_time=AFTER)) > LEFT,
    )


def _is_finally_at_rest(run: Run) -> NDArray[np.bool_]:
    """Return (n,) True from the final standstill of the robot on."""
    moves = np.abs(run.true_twist[:, [0, 2]]).max(axis=1) > _AT_REST
    return ~np.logical_or.accumulate(moves[::-1])[::-1]


def distances(run: Run, near: tuple[float, float] = _NEAR) -> FloatArray:
    """Compute the distance (n,) of the true position from the reference around now, by `near` [s] [m]."""
    times = np.arange(-near[0], run.time[-1] + near[1], 0.05)
    places = run.reference.sample(times).pose[:, :2]
    first = np.searchsorted(times, run.time - near[0])
    last = np.searchsorted(times, run.time + near[1], "right")
    poses = run.true_pose[:, :2]
    away = [np.hypot(*(places[a:b] - pose).T).min() for a, b, pose in zip(first, last, poses, strict=True)]
    return np.array(away)


LEFT = 0.1
"""Distance from the path section around the reference above which the robot has left its path [m]."""
ON_TIME = 0.5
"""Time before and after the present that defines the path section for `LEFT` [s]."""


def _max_distance(run: Run) -> float:
    """Compute the maximum distance from the path section around the reference [m]."""
    return float(distances(run, (ON_TIME, ON_TIME)).max())
