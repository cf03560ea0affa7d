"""Fuzzer of the controller: arbitrary events in any order, and checks of docs/safety.md at every step."""

from __future__ import annotations

import gc
import math
import pickle
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from random import Random
from typing import Any

import casadi as ca
import numpy as np

from diffdrive_mpc import (
    ConfigError,
    Controller,
    Measurement,
    ModelError,
    NonlinearModel,
    Stamped,
    Term,
    load_config,
    load_trajectory,
)
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.solver.report import SolverMethod, SolverStatus
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands, time_segments
from diffdrive_mpc.mpc.trajectories.smooth_segments import time_smooth_path
from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints
from fuzz import odd
from fuzz.case import Case, DeadlineError, FaultError
from fuzz.configs import Overrides, draw_overrides, draw_value, fields

CONFIGS = ("ssm", "ssm", "sm", "mbm", "kinematic", "nonlinear", "windowed")
"""Shipped configurations, and models of `user_model`."""
EXTRAS = ({"fence.enabled": True},)
"""Settings that are off by default and rarely drawn by chance."""
_CHANGEABLE = [
    (key, field_info) for key, field_info in fields(type(load_config("ssm"))) if key.startswith(("weights.", "limits."))
]
_KINDS_OF_EVENTS = (*4 * ("tick",), *2 * ("clock", "start", "update", "hold"), "reset", "overrule", "limit_speed")
_KINDS_OF_EVENTS += ("carry", "foresee", "again", "parameters", "bound")
_REFUSED = (ConfigError, ModelError, ValueError)
_SHARE_OF_TICK = 0.5
"""Deadline of a step, as in the node, as a share of the sample time [-]."""
_ITERATION = 5e-3
"""Maximum time by which a step may exceed its sample time: one iteration of a solver with 200 steps [s]."""

_POSE, _POINT = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 2)
_DISTANCE = ca.sqrt(ca.sumsqr(_POSE[:2] - _POINT) + 1e-6)
_NAMES = ["pose", "parameters"], ["value"]
TERMS = {
    "keep_off": Term(
        "keep_off",
        ca.Function("keep_off", [_POSE, _POINT], [10 * _DISTANCE], *_NAMES),
        "soft",
        lower=[4.0],
        defaults=(10.0, 10.0),
    ),
    "push_off": Term(
        "push_off",
        ca.Function("push_off", [_POSE, _POINT], [45 * ca.fmax(0.45 - _DISTANCE, 0)], *_NAMES),
        defaults=(10.0, 10.0),
    ),
    "wild": Term(
        "wild",
        ca.Function("wild", [_POSE, _POINT], [ca.exp(_POSE[0] * _POINT[0]) / (_POSE[1] - _POINT[1])], *_NAMES),
        defaults=(0.0, 1.0),
    ),
}


@cache
def user_model(name: str) -> NonlinearModel | None:
    """Return a nonlinear model, or None if `name` is the name of a configuration."""
    from nonlinear_program import saturating, windowed

    models = {"nonlinear": saturating, "windowed": windowed}
    return models[name]() if name in models else None


@dataclass
class UserReference:
    """User-defined reference; its poses may contradict its twist."""

    name: str = "own"
    duration: float = 5.0
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    twist: tuple[float, float] = (0.0, 0.0)
    spoils: dict[int, float] = field(default_factory=dict)

    def sample(self, times: Any) -> ReferenceSample:
        """Return samples on a straight line; `spoils` maps the number of a call to its first coordinate."""
        clipped = np.clip(np.atleast_1d(np.asarray(times, dtype=float)), 0.0, self.duration)
        # Infinite velocities are drawn, too: their product with time zero is undefined.
        with np.errstate(invalid="ignore"):
            pose = np.asarray(self.pose) + clipped[:, None] * np.asarray(self.velocity)
            arc_length = clipped * abs(self.twist[0])
        twist = np.tile(np.asarray(self.twist, dtype=float), (len(clipped), 1))
        self._calls = getattr(self, "_calls", 0) + 1
        if self._calls in self.spoils:
            pose[:, 0] = self.spoils[self._calls]
        return ReferenceSample(pose, twist, arc_length)


class ControllerFuzzer:
    """Fuzzer of sequences of events, with random configurations, models and references."""

    name, time_limit, count = "controller", 60.0, 150
    extras: Sequence[Overrides] = EXTRAS
    """Settings that are off by default and rarely drawn by chance."""
    steps = late = 0
    """Number of steps of all checked cases, and number of steps that missed their deadline."""
    longest_step = 0.0
    """Maximum processor time of a step, in units of its sample time."""

    def draw(self, random: Random) -> Case:
        """Draw a configuration, references and events."""
        overrides = draw_overrides(random)
        for extra in self.extras:
            if random.random() < 0.08:
                overrides = {**extra, **overrides}
        terms = [name for name in TERMS if random.random() < 0.07]
        references = [draw_reference(random) for _ in range(random.choice((1, 1, 2, 3)))]
        events = [["start", 0, 0.0], ["drive", random.choice((1, 5, 30, 60, 60, 60, 60, 600))]]
        for _ in range(random.choice((1, 3, 10, 30))):
            events += [*self.draw_feature_events(random, overrides), draw_event(random, len(references), terms)]
            events += [["drive", random.choice((0, 1, 2, 3, 10, 40))]]
        return {
            "config": random.choice(CONFIGS),
            "overrides": overrides,
            "terms": terms,
            "references": references,
            "events": events,
        }

    def draw_feature_events(self, random: Random, overrides: Overrides) -> list[list[Any]]:
        """Draw events for the features that the overrides enable."""
        del random, overrides
        return []

    def make_session(self, controller: Controller, references: list[Any]) -> Session:
        """Return the object that executes the events."""
        return Session(controller, references)

    def check(self, case: Case) -> None:
        """Run the events of a case."""
        try:
            model = user_model(case["config"])
            config = load_config("sm" if model else case["config"], case["overrides"])
            controller = Controller(config, model, [TERMS[name] for name in case["terms"]])
        except _REFUSED as error:
            one_line(error)
            return
        references = []
        for spec in case["references"]:
            try:
                references.append(make_reference(spec))
            except _REFUSED as error:
                one_line(error)
                references.append(load_trajectory("circle"))
        session = self.make_session(controller, references)
        try:
            for event in case["events"]:
                getattr(session, event[0])(*event[1:])
        finally:
            self.steps, self.late = self.steps + session.steps, self.late + session.late
            self.longest_step = max(self.longest_step, session.longest_step)


class Session:
    """Controller and robot of a case; each step is checked."""

    def __init__(self, controller: Controller, references: list[Any]) -> None:
        self.controller, self.references = controller, references
        self.t, self.pose, self.twist, self.last = 0.0, np.zeros(3), np.zeros(2), np.zeros(2)
        self.started, self.steps, self.late, self.longest_step = False, 0, 0, 0.0
        self.bounds: tuple[int | None, float | None] = None, None
        self.measurement = Measurement()
        self.hold_now: Hold | None = None

    def start(self, index: int, t0: float) -> None:
        """Start a reference; its time 0 is `t0` [s] after the current time."""
        try:
            self.controller.start(self.references[index % len(self.references)], self.t + t0)
            self.started = True
        except _REFUSED as error:
            one_line(error)

    def reset(self) -> None:
        """Reset the controller."""
        self.controller.reset()
        self.last = np.zeros(2)

    def update(self, weights: dict[str, Any], limits: dict[str, Any]) -> None:
        """Update weights and limits."""
        try:
            self.controller.update(weights, limits)
        except _REFUSED as error:
            one_line(error)

    def limit_speed(self, v: float | None) -> None:
        """Limit the speed."""
        try:
            self.controller.limit_speed(v)
        except _REFUSED as error:
            one_line(error)

    def overrule(self, commands: list[list[float]]) -> None:
        """Set the commands that another controller has sent."""
        try:
            self.controller.set_applied_commands(commands)
        except ValueError as error:
            one_line(error)
            return
        if commands:
            self.last = np.array(commands[-1], dtype=float)

    def parameters(self, values: dict[str, Any]) -> None:
        """Set stage parameters of terms."""
        try:
            self.controller.set_parameters(**values)
        except _REFUSED as error:
            one_line(error)

    def hold(self, reason: str | None, failure: bool = False) -> None:
        """Hold the robot from the next step on; None ends the hold."""
        self.hold_now = None if reason is None else Hold(reason, failure=failure)

    def bound(self, max_iterations: int | None, seconds: float | None) -> None:
        """Limit iterations and time from the next step on."""
        self.bounds = max_iterations, seconds

    def again(self) -> None:
        """Pickle and unpickle the controller."""
        self.controller = pickle.loads(pickle.dumps(self.controller))
        self.last = np.zeros(2)

    def foresee(self, count: int) -> None:
        """Predict the belief over `count` commands."""
        try:
            belief = self.controller.belief
        except RuntimeError:
            return
        predicted = self.controller.predict_belief(belief, np.tile(self.last, (count, 1)))
        if len(predicted.mean) != len(belief.mean):
            raise FaultError("foreseen: the size differs from that of the belief")

    def carry(self, x: float, y: float, theta: float) -> None:
        """Move the robot."""
        self.pose = self.pose + np.array([x, y, theta])

    def drive(self, count: int) -> None:
        """Run ordinary ticks."""
        for _ in range(count):
            self.tick(self.controller.config.sample_time)

    def tick(self, dt: float, changes: dict[str, Any] | None = None) -> None:
        """Run a tick `dt` [s] after the last tick, with `changes` of the measurement."""
        if not self.started:
            return
        t = self.t + dt
        step = dt if math.isfinite(dt) and 0.0 < dt < 1.0 else 0.0
        # A large or invalid clock jump lasts one tick only.
        if math.isfinite(t) and abs(t) < 1e12:
            self.t = t
        self.twist = self.twist + min(1.0, step / 0.1) * (np.clip(self.last, -1e3, 1e3) - self.twist)
        heading = self.pose[2]
        turn = np.array([np.cos(heading), np.sin(heading)])
        self.pose = self.pose + step * np.array([*(self.twist[0] * turn), self.twist[1]])
        with warnings.catch_warnings():
            # Python code must not cause numerical warnings.
            warnings.simplefilter("error", RuntimeWarning)
            bound, seconds = self.bounds
            measurement, sample_time = self.measured(changes or {}), self.controller.sample_time
            limit = _SHARE_OF_TICK * sample_time
            # Disable garbage collection, because the node excludes existing objects from it at activation.
            gc.disable()
            # Use thread time, because the computer runs other processes.
            start = time.thread_time()
            result = self.controller.step(
                t,
                measurement,
                self.hold_now,
                deadline=time.monotonic() + (seconds if seconds is not None and seconds < limit else limit),
                most_iterations=bound,
            )
            duration = time.thread_time() - start
            gc.enable()
        self.steps, self.late = self.steps + 1, self.late + (result.solver.missed > 0)
        self.longest_step = max(self.longest_step, duration / sample_time)
        if duration > sample_time + _ITERATION:
            text = f"deadline: a step of {1e3 * duration:.1f} ms in a sample of {1e3 * sample_time:g} ms"
            raise DeadlineError(text)
        # A repeated tick has the report of the previous tick.
        is_new = "its command is repeated" not in result.message
        if is_new and bound and result.solver.method == SolverMethod.ACTIVE_SET and result.solver.iterations > bound:
            raise FaultError(f"iterations: {result.solver.iterations} of at most {bound}")
        if result.solver.operations > self.controller.operations_bound:
            raise FaultError(f"operations: {result.solver.operations} of {self.controller.operations_bound} at most")
        check_step(result, self.controller.config, self.last, held=self.hold_now is not None)
        self.last = np.array(result.command)

    def measured(self, changes: dict[str, Any]) -> Measurement:
        """Return the measurement with changes, or the last measurement for "repeat"."""
        if "repeat" in changes:
            return self.measurement
        ordinary = {"pose": self.pose.copy(), "wheel_twist": self.twist.copy(), "yaw_rate": float(self.twist[1])}
        values: dict[str, Any] = {name: Stamped(value, self.t) for name, value in ordinary.items()}
        for name, change in changes.items():
            if name == "sent":
                values["sent"] = tuple(change) if isinstance(change, list) else change
            elif change is None:
                values[name] = None
            else:
                value = change["value"] if "value" in change else ordinary[name] + np.asarray(change.get("shift", 0.0))
                values[name] = Stamped(value, stamp_of(change, self.t), change.get("covariance"))
        self.measurement = Measurement(**values)
        return self.measurement


def stamp_of(change: dict[str, Any], t: float) -> Any:
    """Return the stamp of a changed message."""
    return change["stamp"] if "stamp" in change else t + change.get("later", 0.0)


def check_step(result: Any, config: Any, last: np.ndarray, *, held: bool) -> None:
    """Raise FaultError if a step after the command `last` (2,) violates a guarantee of docs/safety.md."""
    command, limits, dt = np.asarray(result.command), config.limits, config.sample_time
    text = f"{command.tolist()} after {last.tolist()} in {result.mode} ({result.message[:200]})"
    if command.shape != (2,) or not np.isfinite(command).all():
        raise FaultError(f"not finite: {text}")
    if not isinstance(result.message, str) or "\n" in result.message:
        raise FaultError(f"message: not one line: {result.message!r}")
    if not isinstance(result.solver.status, SolverStatus):
        raise FaultError(f"status: it is {result.solver.status!r}")
    if "its command is repeated" in result.message:
        if (command != (0.0 if result.mode == "STOPPED" else last)).any():
            raise FaultError(f"repeated tick: changes the command: {text}")
        return
    if result.mode == "STOPPED":
        if command.any():
            raise FaultError(f"stopped: and moves: {text}")
        return
    is_braking = result.mode in ("BRAKING", "FINISHED")
    if held and result.mode not in ("BRAKING", "FINISHED"):
        raise FaultError(f"held: and drives: {text}")
    upper, lower = np.transpose([limits.v.sides, limits.omega.sides])
    rates = (limits.v_braking, limits.omega_braking) if is_braking else (limits.v_slew, limits.omega_slew)
    rise, fall = np.transpose([sides_of(rate) for rate in rates]) * dt
    size, sign, rounding = np.abs(last), np.where(last < 0.0, -1.0, 1.0), 1e-9 + 1e-9 * np.abs(last)
    # After the sign change, the command grows for the rest of the tick.
    min_size = np.where(size > fall, size - fall, -rise * (1.0 - size / fall))
    ahead, behind = np.where(sign > 0.0, upper, lower), np.where(sign > 0.0, lower, upper)
    if (sign * command > np.maximum(ahead, min_size) + rounding).any() or (sign * command < -behind - rounding).any():
        raise FaultError(f"limits: outside {(-lower).tolist()} to {upper.tolist()}: {text}")
    if (sign * command > size + rise + rounding).any() or (sign * command < min_size - rounding).any():
        raise FaultError(f"slew: grows by more than {rise.tolist()} or falls by {fall.tolist()} in a tick: {text}")
    if is_braking and (np.abs(command) > np.abs(last)).any():
        raise FaultError(f"brakes: and speeds up: {text}")
    if result.mode == "TRACKING":
        if not result.solver.status.usable:
            raise FaultError(f"status: tracks, and {result.solver.status}: {text}")
        for name, values in (("estimate", result.estimate.pose), ("plan", result.plan)):
            if values is not None and not np.isfinite(values).all():
                raise FaultError(f"{name}: tracks, and it is not finite: {text}")
    if not 0.0 <= result.progress <= 2.0 + 1e-9:
        raise FaultError(f"progress: {result.progress}: {text}")


def one_line(error: BaseException) -> None:
    """Raise FaultError unless the message of an error is one line."""
    text = str(error)
    if not text.strip() or "\n" in text:
        raise FaultError(f"message: not one line: {text[:300]!r}")


def draw_reference(random: Random) -> Case:
    """Draw the description of a reference."""
    kind = random.choice(("named", "segments", "segments", "waypoints", "spline", "own", "own"))
    if kind == "named":
        return {
            "kind": kind,
            "name": random.choice(("circle", "s", "cane", "square", "k_turn", "tight", "reverse_slalom")),
        }
    if kind == "spline":
        return {"kind": kind, "seed": random.randrange(1000)}
    if kind == "segments":
        segments = [
            [draw_speed(random, 0.5), draw_speed(random, 0.8), min(abs(draw_speed(random, 3.0)) or 1e-9, 1e3)]
            for _ in range(random.choice((1, 1, 2, 3, 8)))
        ]
        return {"kind": kind, "segments": segments, "way": random.choice(("stop", "commanded", "smooth"))}
    if kind == "waypoints":
        points = [[draw_speed(random, 2.0), draw_speed(random, 2.0)] for _ in range(random.choice((2, 2, 3, 4, 8)))]
        return {"kind": kind, "points": points, "way": random.choice(("stop", "commanded", "smooth"))}
    speed = random.choice((0.0, 0.3, -0.3, 1e-9, draw_speed(random, 0.3)))
    return {
        "kind": "own",
        "duration": random.choice((0.0, 1e-9, 0.01, 5.0, 5.0, 1e6, odd.number(random))),
        "pose": [draw_speed(random, 1.0) for _ in range(3)],
        "velocity": random.choice(([speed, 0.0, 0.0], [0.0, 0.0, 0.0], [draw_speed(random, 1.0) for _ in range(3)])),
        "twist": [speed, random.choice((0.0, 0.0, draw_speed(random, 0.5)))],
        "spoils": {str(random.randrange(2, 60)): odd.number(random)} if random.random() < 0.2 else {},
    }


def draw_speed(random: Random, scale: float) -> float:
    """Draw a number of this scale, sometimes an extreme number."""
    if random.random() < 0.08:
        return odd.number(random)
    return random.choice((0.0, scale, -scale, random.gauss(0.0, scale), random.gauss(0.0, 1e-3 * scale)))


def make_reference(spec: Case) -> Any:
    """Return the reference of a case; raise ValueError if it is invalid."""
    limits = TrajectoryLimits.of_robot()
    if spec["kind"] == "named":
        return load_trajectory(spec["name"])
    if spec["kind"] == "spline":
        return load_trajectory(f"spline-{spec['seed']}")
    if spec["kind"] == "segments":
        try:
            segments = [Segment(v=v, omega=omega, duration=duration) for v, omega, duration in spec["segments"]]
        except ValueError as error:  # pydantic's message has several lines
            raise ValueError("no such segment") from error
        lay = {"stop": time_segments, "commanded": time_commands, "smooth": time_smooth_path}[spec["way"]]
        return checked_reference(lay(segments, limits, name="segments"), limits)
    if spec["kind"] == "waypoints":
        points = [tuple(point) for point in spec["points"]]
        if not all(abs(value) <= 1e6 for point in points for value in point):
            raise ValueError("the schema of trajectory files rejects these points")
        return checked_reference(time_waypoints(points, limits, name="waypoints", timing=spec["way"]), limits)
    return UserReference(
        duration=spec["duration"],
        pose=tuple(spec["pose"]),
        velocity=tuple(spec["velocity"]),
        twist=tuple(spec["twist"]),
        spoils={int(call): value for call, value in spec["spoils"].items()},
    )


def checked_reference(reference: Any, limits: TrajectoryLimits) -> Any:
    """Return an accepted reference; raise FaultError unless it is finite, continuous and within the limits."""
    if not (math.isfinite(reference.duration) and reference.duration >= 0.0):
        raise FaultError(f"duration: {reference.duration}")
    horizon = min(reference.duration, 3600.0)
    times = np.linspace(-0.1, horizon + 0.1, 2000)
    sample = reference.sample(times)
    for name, values in (("pose", sample.pose), ("twist", sample.twist), ("arc length", sample.arc_length)):
        if not np.isfinite(values).all():
            raise FaultError(f"reference: its {name} is not finite")
    max_twist = np.abs(sample.twist).max(axis=0)
    if (max_twist > 1.01 * np.array([limits.v, limits.omega]) + 1e-9).any():
        raise FaultError(f"reference: it is as fast as {max_twist.tolist()}")
    distances = np.hypot(*np.diff(sample.pose[:, :2], axis=0).T)
    if (distances > 1.02 * limits.v * np.diff(times) + 1e-9 * (1.0 + np.abs(sample.pose[1:, :2]).max())).any():
        raise FaultError("reference: its poses jump")
    if (np.diff(sample.arc_length) < -1e-9 * (1.0 + np.abs(sample.arc_length[1:]))).any():
        raise FaultError("reference: its arc length goes back")
    return reference


def draw_event(random: Random, references: int, terms: list[str]) -> Case:
    """Draw an event between ticks, or an odd tick."""
    kind = random.choice(_KINDS_OF_EVENTS)
    if kind == "tick":
        return ["tick", 0.0202, draw_changes(random)]
    if kind == "clock":
        dt = random.choice(
            (0.0, 1e-9, 0.003, 0.0101, -0.0202, -1e-6, -1.0, 0.1, 0.35, 0.45, 3.0, 100.0, 1e9, odd.number(random))
        )
        return ["tick", dt, draw_changes(random) if random.random() < 0.5 else {}]
    if kind == "start":
        return [
            "start",
            random.randrange(references),
            random.choice((0.0, 0.0, -3.0, 1.0, -1e6, 1e6, odd.number(random))),
        ]
    if kind == "update":
        selected = random.sample(_CHANGEABLE, random.choice((1, 1, 2, 5)))
        groups: dict[str, dict[str, Any]] = {"weights": {}, "limits": {}}
        for key, field_info in selected:
            group, _, name = key.partition(".")
            groups[group][name] = draw_value(random, field_info)
        return ["update", groups["weights"], groups["limits"]]
    if kind == "overrule":
        count = random.choice((0, 1, 1, 2, 5, 60))
        scale = random.choice((0.0, 0.3, 1.0, 5.0, 1e3, 1e160))
        return ["overrule", [[random.gauss(0.0, scale), random.gauss(0.0, scale)] for _ in range(count)]]
    if kind == "limit_speed":
        return [kind, random.choice((None, 0.2, 0.05, 1e-9, 10.0, odd.number(random)))]
    if kind == "hold":
        return ["hold", random.choice((None, None, "held", "")), random.random() < 0.3]
    if kind == "bound":
        return [
            "bound",
            random.choice((None, None, 1, 2, 5, 50)),
            random.choice((None, None, -1.0, 1e-5, 2e-4, 0.01, odd.number(random))),
        ]
    if kind == "carry":
        return ["carry", *[random.choice((0.0, 0.05, 0.3, 2.0, -1.0, 1e5)) for _ in range(3)]]
    if kind == "foresee":
        return ["foresee", random.choice((0, 1, 50))]
    if kind == "parameters" and terms:
        return ["parameters", {random.choice(terms): [draw_speed(random, 1.0), draw_speed(random, 1.0)]}]
    return ["reset"] if kind in ("reset", "parameters") else ["again"] if random.random() < 0.2 else ["reset"]


def draw_changes(random: Random) -> dict[str, Any]:
    """Draw changes of a measurement."""
    changes: dict[str, Any] = {"repeat": True} if random.random() < 0.05 else {}
    for name, size in (("pose", 3), ("wheel_twist", 2), ("yaw_rate", 1)):
        if random.random() < 0.4:
            changes[name] = draw_message(random, size)
    if random.random() < 0.2:
        changes["sent"] = random.choice(
            ([0.0, 0.0], [draw_speed(random, 0.5), draw_speed(random, 0.5)], [1e160, -1e300], "rubbish", [1.0])
        )
    return changes


def draw_message(random: Random, size: int) -> Any:
    """Draw a message with an odd value, stamp or covariance; None for a missing message."""
    kind = random.randrange(8)
    if kind == 0:
        return None
    message: dict[str, Any] = {}
    if kind in (1, 2):
        message["value"] = [odd.near(0.1, random) for _ in range(size)] if size > 1 else odd.near(0.1, random)
    if kind == 3:
        message["value"] = random.choice(("rubbish", [], [1.0], [[1.0, 2.0]], {"x": 1}, True, [None, None, None]))
    if kind in (4, 5):
        message["shift"] = [random.gauss(0.0, 0.5) for _ in range(size)] if size > 1 else random.gauss(0.0, 0.5)
    if kind in (5, 6):
        message["later"] = random.choice((-0.02, -0.3, -0.5, -10.0, 0.05, 1.0, 1e3, odd.number(random)))
    if kind == 7:
        message["stamp"] = random.choice((odd.number(random), "then", None, [1.0]))
    if random.random() < 0.25:
        diagonal = [abs(odd.near(1e-4, random)) for _ in range(size)]
        message["covariance"] = (
            np.diag(diagonal).tolist() if random.random() < 0.7 else [[odd.number(random)] * size] * size
        )
    return message
