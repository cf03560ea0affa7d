"""The oracle's controller: computation of a command from measurements, and failure modes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc import ControllerConfig, VelocityModel, load_model
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.two_sided import SlewLimit
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.fixed_values import AHEAD, BEHIND, STANDING, TURNING
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.reentry import Pursuit, Target, TooFar
from diffdrive_mpc.mpc.solver.report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.step_result import Mode
from oracle.clock import TickClock, TickKind
from oracle.estimate import Estimate
from oracle.estimator import StateEstimator
from oracle.fence import FenceWatch
from oracle.problem import TrackingProblem, command_box, reachable_commands
from oracle.reach import ASTRAY, BESIDE, WheelReach
from oracle.solver import solve
from oracle.tick import FeedForward, begin_tick
from oracle.trajectories import with_numpy_samples

# Constants of mpc/config/sensor_test.yaml: [rad], [s].
_TURN_OF_DISPLACEMENT, _RETURN_TIME = 1.5, 1.0
_NOT_RUN = SolverReport(SolverStatus.NOT_RUN)


@dataclass(frozen=True)
class Plan:
    """Commands (N, 2), predicted poses (N + 1, 3), and tracked poses (N + 1, 3)."""

    commands: FloatArray
    poses: FloatArray
    reference: FloatArray


@dataclass(frozen=True)
class Outcome:
    """Decision of one tick."""

    command: FloatArray
    mode: Mode
    solver: SolverReport = _NOT_RUN
    plan: Plan | None = None
    blocked_for: float = 0.0


@dataclass(frozen=True)
class OracleStep:
    """Result of one step, like `mpc.StepResult`."""

    command: FloatArray
    mode: Mode
    message: str
    solver: SolverReport
    plan: FloatArray | None
    planned_commands: FloatArray | None
    reference: FloatArray | None
    progress: float
    reference_delay: float
    estimate: Estimate | None
    blocked_for: float


@dataclass(frozen=True)
class Deviation:
    """Deviation of the robot from a reference pose: True if outside the band, and delay [s]."""

    outside: bool
    late: float


class OracleController:
    """Independent implementation of `mpc.Controller` with the same constructor, start, reset, step and update."""

    def __init__(self, config: ControllerConfig, model: VelocityModel | str | None = None) -> None:
        extra = config.extra_dead_time
        if model is None:
            self.model = load_model(config.model).with_extra_dead_time([extra.v, extra.omega])
        else:
            self.model = model if isinstance(model, VelocityModel) else load_model(model)
        if not config.compensation.dead_time:
            self.model = replace(self.model, dead_time=np.zeros(2))
        self.sampled_model = self.model.discretise(config.sample_time)
        self.estimator = StateEstimator(
            self.sampled_model,
            config.estimator,
            config.compensation,
            config.wheels,
            config.failure.max_pose_age,
            config.sensors,
        )
        spare = self.estimator.filter.spare
        self.feed_forward = FeedForward(self.model, config.sample_time, config.horizon, spare)
        self.ahead = np.arange(self.feed_forward.samples) * config.sample_time
        self.reach = WheelReach(config, self.model.dc_gain, int(self.feed_forward.ahead.max()))
        self.next_twists = np.zeros((2, 2))
        self.target_pose = np.zeros(3)
        self.pursuit = Pursuit(config, self._deviation)
        self.clock = TickClock(config.sample_time, self.estimator.max_pause)
        self.reference: Reference | None = None
        self.pending: ControllerConfig | None = None
        self.guess: FloatArray | None = None
        self._configure(with_increments(config, self.sampled_model))
        self.reset()

    def _configure(self, config: ControllerConfig) -> None:
        self.config = config
        self.problem = TrackingProblem(config, self.sampled_model)
        self.pursuit.configure(config)
        self.reach.max_speed = config.limits.wheel_speed

    def start(self, reference: Reference, t0: float) -> None:
        """Start tracking `reference`; its time 0 is `t0` [s] on the clock of `step`."""
        self._forget()
        self.reference, self.t0 = with_numpy_samples(reference), t0
        self.fence = FenceWatch(self.config, reference)
        self.pursuit.start(self.reference, native=False)

    def reset(self) -> None:
        """Restore the initial state of a robot at rest, with the current reference."""
        self._forget()
        self.estimator.commands.clear()
        self.last = np.zeros(2)

    def _forget(self) -> None:
        self.estimator.forget()
        self.fence = FenceWatch(self.config, self.reference)
        self.reach.restart()
        self.pursuit.restart()
        self.clock.restart()
        self.guess = None
        self.plan: Plan | None = None
        self.plan_age = 0
        self.turn_tolerance, self.passed_twist = 0.0, np.zeros(2)
        self.result: OracleStep | None = None
        self.has_driven = self.latched = self.finished = self.in_outage = False
        self.time = self.last_good_time = 0.0
        self.cause = ""

    def resume(self) -> None:
        """Continue after a failure that has stopped the robot."""
        self.latched, self.last_good_time, self.cause = False, self.time, ""

    def update(
        self, weights: Mapping[str, float] | None = None, limits: Mapping[str, float] | None = None
    ) -> ControllerConfig:
        """Change weights and limits while driving; they take effect at the start of the next step."""
        groups = {"weights": weights or {}, "limits": limits or {}}
        changes = {f"{group}.{key}": value for group, values in groups.items() for key, value in values.items()}
        self.pending = replace_values(self.pending or self.config, changes)
        return self.pending

    def set_applied_commands(self, commands: FloatArray) -> None:
        """Replace the last K commands by the applied ones (K, 2), oldest first."""
        self.estimator.commands.overrule(commands)
        self.last = commands[-1]

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> OracleStep:
        """Return the result of the tick at `t` [s], from the inputs since the last tick."""
        assert self.reference is not None, "call start first"
        if self.pending is not None:
            self._configure(self.pending)
            self.pending = None
        notes: list[str] = []
        self.gap = 0.0 if self.clock.last is None else t - self.clock.last
        kind, fault = self.clock.judge(t)
        notes += [fault] if fault else []
        if kind is TickKind.REPEATED and self.result is not None:
            notes += self.estimator.update(t, measurement)
            return replace(self.result, message="; ".join(notes))
        self.in_outage = False
        if kind in (TickKind.NEW, TickKind.PAUSED):
            self.time = t
        if kind is TickKind.NEW:
            outcome = self._tick(t, measurement, notes, hold)
            self.estimator.commands.append(outcome.command)
        else:
            outcome = self._lost_time(kind, notes)
            # The tick does not start an interval of the model: the command replaces the command of the last tick.
            self.estimator.commands.correct_last(outcome.command)
        if not self.in_outage:
            self.last_good_time = self.time
        self.last = outcome.command
        self.has_driven |= outcome.mode is Mode.TRACKING
        plan = outcome.plan
        self.result = OracleStep(
            command=outcome.command,
            mode=outcome.mode,
            message="; ".join(notes),
            solver=outcome.solver,
            plan=plan and plan.poses,
            planned_commands=plan and plan.commands,
            reference=plan and plan.reference,
            progress=self.pursuit.progress,
            reference_delay=self.pursuit.delay,
            estimate=self.estimator.estimate if self.estimator.ready else None,
            blocked_for=outcome.blocked_for,
        )
        return self.result

    def _lost_time(self, kind: TickKind, notes: list[str]) -> Outcome:
        """Brake in a tick without usable time; send zero after a jump, because the base has stopped by then."""
        gap, limit = self.gap, self.config.failure.resume_within
        outcome = self._brake(notes, waits=(kind is TickKind.PAUSED and gap > limit) or gap < -limit)
        if kind is TickKind.PAUSED:
            self.estimator.forget()
            self.estimator.commands.clear()
        return outcome if kind is TickKind.FAULTY else Outcome(np.zeros(2), Mode.STOPPED)

    def _tick(self, t: float, measurement: Measurement, notes: list[str], hold: Hold | None) -> Outcome:
        estimator, failure = self.estimator, self.config.failure
        reference_time = self.pursuit.advance(t - self.t0)
        notes += estimator.correct_sent(measurement.sent, self._max_sent(measurement.sent))
        estimator.advance(t)
        notes += estimator.update(t, measurement)
        rate = estimator.rate
        notes += rate.words()
        if hold is not None:
            failing = hold.failure or hold.waits
            return self._brake(notes, hold.reason, failure=failing, outage=hold.failure, waits=hold.waits)
        if not estimator.ready:
            notes += rate.missing()
            return self._brake(notes, "no pose has arrived yet", outage=True)
        if estimator.moved:
            old_pose, reason = estimator.estimate.pose, "consecutive poses agree on a different position"
            if not self._restart():
                return self._brake(notes, reason)
            jump = np.hypot(*(estimator.estimate.pose - old_pose)[:2])
            if self.has_driven and not jump <= failure.max_position_error:
                return self._brake(notes, reason, waits=True)
        estimate = estimator.estimate
        if not np.isfinite(estimate.pose).all():
            estimator.forget()
            return self._brake(notes, "the estimate is not finite; it restarts")
        if estimate.pose_age > failure.max_pose_age + rate.usual_age:
            notes += rate.missing()
            return self._brake(notes, f"no pose was accepted for {estimate.pose_age:.2f} s", outage=True)
        if rate.rare:
            return self._brake(notes)
        if not self.fence.holds(estimator, self.last):
            size = f"{self.config.fence.length:g} by {self.config.fence.width:g} m"
            return self._brake(notes, f"the stopping path leaves the fence of {size}; call start or reset to drive on")
        if self.latched:
            return self._brake(notes)
        self._update_turn_tolerance(estimator.filter.slip(estimator.nodes[-1].posterior.mean))
        astray = self._is_astray() if self.plan is not None and self.plan_age == 0 else None
        self.reach.update(estimator.twist_gates.wheels, t, self.next_twists, estimate.slip, estimator.commands, astray)
        if self._at_the_end(estimate, reference_time, notes):
            return Outcome(self._ramp(), Mode.FINISHED)
        target = self.pursuit.target(t - self.t0, reference_time, estimate, self.ahead, self.reach.allowed)
        if isinstance(target, TooFar):
            limit = failure.max_position_error
            reason = f"{target.distance:.2f} m from the reference; the limit is {limit} m"
            return self._brake(notes, reason, outage=True)
        notes += [target.message] if target.message else []
        return self._track(estimate, target, notes)

    def _deviation(self, pose: FloatArray, twist: FloatArray) -> Deviation:
        """Locate the estimate relative to a reference pose (3,) with twist (2,): excess over the band, and delay."""
        settings, estimate = self.config.reentry, self.estimator.estimate
        x, y, theta = estimate.pose - pose
        c, s = np.cos(pose[2]), np.sin(pose[2])
        along, lateral, heading_error = c * x + s * y, c * y - s * x, math.remainder(theta, math.tau)
        v, omega = twist
        ahead = math.copysign(along, along * v)
        is_near = -BEHIND * settings.wait <= ahead <= AHEAD * settings.wait
        # Uncertainty of the pose must not start re-entry.
        band = self.turn_tolerance + max(settings.band, 3.0 * math.hypot(*estimate.pose_deviation[:2]))
        outside = abs(lateral) > band or abs(heading_error) > settings.heading_band or not is_near
        if abs(v) > STANDING:
            return Deviation(outside, -ahead / settings.wait)
        # While the reference rests or turns on the spot, the delay is the time to reach it.
        turning = -math.copysign(1.0, omega) * heading_error if abs(omega) > TURNING else 0.0
        distance = max(math.hypot(along, lateral) - self.turn_tolerance, 0.0)
        return Deviation(outside, max(distance / settings.wait, turning / settings.heading_wait))

    def _update_turn_tolerance(self, slip: Slip) -> None:
        """Update the tolerance after turns on the spot: the displacement of the turning point over 1.5 rad."""
        self.turn_tolerance *= 1.0 - self.config.sample_time / _RETURN_TIME
        v, omega = np.abs(self.passed_twist)
        if v <= STANDING and omega > TURNING:
            displacement = math.hypot(slip.turn_ahead, slip.turn_left) + math.hypot(slip.slide_x, slip.slide_y)
            self.turn_tolerance = max(self.turn_tolerance, _TURN_OF_DISPLACEMENT * displacement)

    def _is_astray(self) -> bool:
        """Return True if the robot is late or off the path."""
        pose, twist = self.target_pose, self.next_twists[1]
        x, y, _ = self.estimator.estimate.pose - pose
        lateral = np.cos(pose[2]) * y - np.sin(pose[2]) * x
        deviation = self._deviation(pose, twist)
        return bool(deviation.late > ASTRAY or abs(lateral) > BESIDE * self.config.reentry.band or deviation.outside)

    def _restart(self) -> bool:
        """Restart the estimate at the position of the consistent rejected poses if the commands have been zero."""
        is_at_rest = not self.estimator.commands.recent[-self.sampled_model.memory :].any()
        return is_at_rest and self.config.failure.resume and self.estimator.restart_elsewhere()

    def _at_the_end(self, estimate: Estimate, time: float, notes: list[str]) -> bool:
        """Return True once the robot rests at the end of its reference, or after the timeout; the result is latched."""
        settings, reference = self.config.finish, self.reference
        assert reference is not None
        if self.finished or time < reference.duration:
            return self.finished
        distance = float(np.hypot(*(estimate.pose - reference.sample([reference.duration]).pose[0])[:2]))
        settled = distance <= settings.position and bool((np.abs(estimate.twist) <= settings.speed).all())
        late = time >= reference.duration + settings.timeout
        if late and not settled:
            notes.append(f"finished {distance:.3f} m from the end, not at rest within {settings.timeout} s")
        self.finished = settled or late
        return self.finished

    def _track(self, estimate: Estimate, target: Target, notes: list[str]) -> Outcome:
        limits, failure = self.config.limits, self.config.failure
        plan, status = self._plan(estimate, target)
        report = SolverReport(status)
        if plan is not None:
            self.plan, self.plan_age = plan, 0
            # Commands to a blocked base must stay small, because it would jump on release.
            share = self.config.reentry.blocked_share if target.blocked_for else 1.0
            command = self._inside(plan.commands[0], limits, share)
            return Outcome(command, Mode.TRACKING, report, plan, target.blocked_for)
        notes.append(f"solve failed: {status}")
        self.plan_age += 1
        if self.plan is not None and self.plan_age <= min(failure.max_reused_ticks, self.config.horizon - 1):
            command = self._inside(self.plan.commands[self.plan_age], limits)
            return Outcome(command, Mode.REUSED_PLAN, report, self.plan)
        return replace(self._brake(notes), solver=report)

    def _plan(self, estimate: Estimate, target: Target) -> tuple[Plan | None, SolverStatus]:
        """Run one real-time iteration: linearise along the shifted plan, solve, store the plan."""
        config, sample = self.config, target.sample or target.reference.sample(target.time + self.ahead)
        self.passed_twist = sample.twist[0]
        self.target_pose, self.problem.reach = sample.pose[1], self.reach.allowed
        self.next_twists = sample.twist[: config.horizon + 1]
        tick = begin_tick(self.feed_forward, estimate, self.estimator.commands.recent, self.last, sample)
        if self.guess is None:
            box = command_box(config.limits, config.sample_time, self.last, config.horizon)
            self.guess = np.clip(tick.feed_forward, *box)
        ahead = self.problem.turning_points(tick, self.guess)
        solution = solve(self.problem.quadratic_program(tick, self.guess))
        if not solution.status.usable:
            self.guess = None
            return None, solution.status
        commands = solution.x.reshape(-1, 2)
        self.guess = np.vstack([commands[1:], commands[-1:]])
        twists = self.problem.twists(tick, commands[:, :, None])
        poses = self.problem.poses(tick, twists, ahead)[:, :, 0]
        return Plan(commands, poses, tick.aim), solution.status

    def _brake(
        self, notes: list[str], *reasons: str, failure: bool = True, outage: bool = False, waits: bool = False
    ) -> Outcome:
        notes += reasons
        self.plan = self.guess = None
        self.in_outage = outage and not waits
        is_lasting = self.in_outage and self.time - self.last_good_time > self.config.failure.resume_within
        # Before the first drive and after the end, resuming is not possible.
        if self.has_driven and not self.finished:
            self.latched |= waits or is_lasting or (failure and not self.config.failure.resume)
        if self.latched:
            cause = f" ({self.cause})" if self.cause else ""
            self.cause = self.cause or "; ".join(notes)
            notes.append(f"stopped after a failure{cause}; call start or resume to drive on")
        command = self._ramp()
        return Outcome(command, Mode.BRAKING if command.any() else Mode.STOPPED)

    def _max_sent(self, sent: object) -> FloatArray:
        """Return the maximum command (2,) that the base can have received, with the signs of `sent` and a margin."""
        sides = np.transpose([self.config.limits.v.sides, self.config.limits.omega.sides])
        sent = np.zeros(2) if sent is None else np.asarray(sent, dtype=float)
        return 1.001 * np.maximum(np.where(sent < 0.0, sides[1], sides[0]), np.abs(self.last))

    def _ramp(self) -> FloatArray:
        limits = self.config.limits
        braking = {"v_slew": SlewLimit(limits.v_braking), "omega_slew": SlewLimit(limits.omega_braking)}
        command = self._inside(np.zeros(2), limits.model_copy(update=braking))
        return np.where(np.abs(command) < 1e-13, 0.0, command)

    def _inside(self, command: FloatArray, limits: Limits, share: float = 1.0) -> FloatArray:
        """Return the nearest command within `share` of the range and within the slew from the last command."""
        low, high = reachable_commands(limits, self.config.sample_time, self.last)
        (forward, reverse), (left, right) = limits.v.sides, limits.omega.sides
        upper = np.clip(share * np.array([forward, left]), low, None)
        lower = np.clip(-share * np.array([reverse, right]), None, high)
        return np.clip(command, np.maximum(low, lower), np.minimum(high, upper))
