"""The controller: one tick straight down from measurement to command, and what happens when a part of it fails."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.load import load_model
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.bounds import clip_command, inside_limits
from diffdrive_mpc.mpc.compiled.estimator import CompiledEstimator
from diffdrive_mpc.mpc.compiled.library import compiled_or_not
from diffdrive_mpc.mpc.compiled.reference import compile_reference
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.estimator import StateEstimator
from diffdrive_mpc.mpc.finish import FinishWatch
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.planner import Plan, Planner
from diffdrive_mpc.mpc.reentry import Pursuit, Target, TooFar
from diffdrive_mpc.mpc.reference_check import check_speeds
from diffdrive_mpc.mpc.solver_report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.tick_clock import TickClock, TickKind

_NOT_RUN = SolverReport(SolverStatus.NOT_RUN)
_CHANGEABLE = ("weights", "limits")


class _Outcome(NamedTuple):
    """What one tick decided."""

    command: FloatArray
    mode: Mode
    solver: SolverReport = _NOT_RUN
    plan: Plan | None = None
    blocked_for: float = 0.0


class Controller:
    """Tracks a timed reference with a velocity model.

    Parameters
    ----------
    config
        The configuration, see `mpc.load_config`.
    model
        A velocity model or the name of one, instead of the configuration's. The extra dead time belongs to the
        configuration's model, so another one is taken as it is.

    Raises
    ------
    models.checked_yaml.ConfigError, models.velocity_model.ModelError, ValueError
        If the model cannot be loaded or used, or the horizon is too short for the dead time.
    """

    def __init__(self, config: ControllerConfig, model: VelocityModel | str | None = None) -> None:
        extra = config.extra_dead_time
        if model is None:
            self._model = load_model(config.model).with_extra_dead_time([extra.v, extra.omega])
        else:
            self._model = model if isinstance(model, VelocityModel) else load_model(model)
        if not config.compensation.dead_time:
            self._model = replace(self._model, dead_time=np.zeros(2))
        self._config = config
        self._pending: ControllerConfig | None = None
        sampled = self._model.discretise(config.sample_time)
        parts = (sampled, config.estimator, config.compensation, config.wheels)
        self._estimator = compiled_or_not(
            config.solver.compiled, lambda: CompiledEstimator(*parts), lambda: StateEstimator(*parts)
        )
        self._planner = Planner(config, self._model)
        self._pursuit = Pursuit(config)
        self._finish = FinishWatch()
        self._clock = TickClock(config.sample_time, self._estimator.longest_pause)
        self._reference: Reference | None = None
        self._tracked: Reference | None = None
        self._t0 = 0.0
        self.reset()

    @property
    def config(self) -> ControllerConfig:
        """The configuration in force."""
        return self._config

    @property
    def model(self) -> VelocityModel:
        """The velocity model, extra dead time included."""
        return self._model

    @property
    def compiled(self) -> bool:
        """Whether it runs as compiled C: it does where there is a compiler, unless `solver.compiled` is never."""
        return isinstance(self._estimator, CompiledEstimator) and self._planner.compiled

    @property
    def reference(self) -> Reference | None:
        """The reference being tracked."""
        return self._reference

    def start(self, reference: Reference, t0: float) -> None:
        """Track `reference` from now on; its time 0 is `t0` [s] on the clock of `step`.

        The estimate starts anew, and so does the clock. The robot may be moving: commands on their way are remembered,
        and the next command keeps the slew limit against the last.

        Raises
        ------
        ValueError
            If `t0` is not finite, or the reference is faster than the limits of the configuration.
        """
        if not math.isfinite(t0):
            raise ValueError(f"t0 = {t0}: the start time must be finite")
        check_speeds(reference, self._config.limits, self._config.sample_time)
        self._forget()
        self._reference, self._t0 = reference, t0
        self._tracked = compiled_or_not(
            self._config.solver.compiled, lambda: compile_reference(reference), lambda: reference
        )
        self._pursuit.start(self._tracked)

    def reset(self) -> None:
        """Be as new, for a robot that stands still: forget estimate, plan and commands. The reference stays."""
        self._forget()
        self._estimator.commands.clear()
        self._last = np.zeros(2)

    def _forget(self) -> None:
        self._estimator.forget()
        self._planner.reset()
        self._pursuit.restart()
        self._clock.restart()
        self._plan: Plan | None = None
        self._plan_age = 0
        self._result: StepResult | None = None
        self._has_driven = False
        self._latched = False
        self._finish.restart()

    def update(
        self, weights: Mapping[str, float] | None = None, limits: Mapping[str, float] | None = None
    ) -> ControllerConfig:
        """Change weights and limits while driving; they take effect at the start of the next step.

        A limit that is tightened below the present command is reached at the slew limit.

        Returns
        -------
        ControllerConfig
            The configuration from the next step on.

        Raises
        ------
        models.checked_yaml.ConfigError
            If a key is unknown or a value out of range; then nothing changes.
        """
        changes = {
            f"{group}.{key}": value
            for group, values in zip(_CHANGEABLE, (weights, limits), strict=True)
            for key, value in (values or {}).items()
        }
        self._pending = replace_values(self._pending or self._config, changes)
        return self._pending

    def step(self, t: float, measurement: Measurement, hold: Hold | None = None) -> StepResult:
        """Decide the command for the tick at `t` [s] from what arrived since the last one.

        Never raises on data: a measurement that is not finite, jumps or is too old is rejected and `message` says so;
        the robot dead-reckons, and brakes when no pose was accepted for `failure.max_pose_age`.
        With `hold` it brakes and stands instead of driving; it goes on measuring.

        Raises
        ------
        RuntimeError
            If `start` was not called.
        """
        started = time.perf_counter()
        if self._tracked is None:
            raise RuntimeError("no reference: call start(reference, t0) before step")
        self._apply_pending()
        notes: list[str] = []
        kind, fault = self._clock.judge(t)
        if fault:
            notes.append(fault)
        if kind is TickKind.REPEATED and self._result is not None:
            notes.extend(self._estimator.update(t, measurement))
            return replace(self._result, message="; ".join(notes), step_time=time.perf_counter() - started)
        if kind is TickKind.NEW:
            outcome = self._tick(t, measurement, self._tracked, notes, hold)
            self._estimator.commands.append(outcome.command)
        else:
            outcome = self._lost_time(kind, notes)
            # No interval of the model begins here: the command in force since the last tick has changed.
            self._estimator.commands.correct_last(outcome.command)
        self._last = outcome.command
        self._has_driven = self._has_driven or outcome.mode is Mode.TRACKING
        self._result = StepResult(
            command=outcome.command.copy(),
            mode=outcome.mode,
            message="; ".join(notes),
            solver=outcome.solver,
            plan=None if outcome.plan is None else outcome.plan.poses,
            planned_commands=None if outcome.plan is None else outcome.plan.commands,
            reference=None if outcome.plan is None else outcome.plan.reference,
            progress=self._pursuit.progress,
            reference_delay=self._pursuit.delay,
            estimate=self._estimator.estimate if self._estimator.ready else None,
            blocked_for=outcome.blocked_for,
            step_time=time.perf_counter() - started,
        )
        return self._result

    def _apply_pending(self) -> None:
        if self._pending is None:
            return
        self._config, self._pending = self._pending, None
        self._planner = Planner(self._config, self._model)
        self._pursuit.configure(self._config)

    def _lost_time(self, kind: TickKind, notes: list[str]) -> _Outcome:
        """Brake: this tick tells nothing. Where the clock leapt, stand: a base without commands has stopped itself."""
        outcome = self._brake(notes)
        if kind is TickKind.PAUSED:
            self._estimator.forget()
            self._estimator.commands.clear()
        return outcome if kind is TickKind.FAULTY else _Outcome(np.zeros(2), Mode.STOPPED)

    def _tick(
        self, t: float, measurement: Measurement, reference: Reference, notes: list[str], hold: Hold | None
    ) -> _Outcome:
        estimator, failure = self._estimator, self._config.failure
        reference_time = self._pursuit.advance(t - self._t0)
        notes.extend(estimator.correct_sent(measurement.sent))
        if measurement.sent is not None:
            self._last = self._slew_base()
        estimator.advance(t)
        notes.extend(estimator.update(t, measurement))
        if hold is not None:
            return self._brake(notes, hold.reason, failure=hold.failure)
        if not estimator.ready:
            return self._brake(notes, "no pose has arrived yet")
        if estimator.moved and not self._restart():
            return self._brake(notes, "poses agree that the robot is somewhere else")
        estimate = estimator.estimate
        if not math.isfinite(sum(estimate.pose.tolist())):
            estimator.forget()
            return self._brake(notes, "the estimate is not finite; it starts anew")
        if estimate.pose_age > failure.max_pose_age:
            return self._brake(notes, f"no pose was accepted for {estimate.pose_age:.2f} s")
        if self._latched:
            return self._brake(notes, "stopped after a failure; call start or reset to drive on")
        if self._finish.look(estimate, reference_time, reference, self._config.finish, notes):
            return _Outcome(self._ramp(), Mode.FINISHED)
        target = self._pursuit.target(t - self._t0, reference_time, estimate, self._planner.ahead)
        if isinstance(target, TooFar):
            return self._brake(
                notes, f"{target.distance:.2f} m from the reference; the limit is {failure.max_position_error} m"
            )
        if target.message:
            notes.append(target.message)
        return self._track(estimate, target, notes)

    def _track(self, estimate: Estimate, target: Target, notes: list[str]) -> _Outcome:
        plan, report = self._planner.plan(
            estimate, self._estimator.commands.recent, self._last, target.reference, target.time, target.sample
        )
        if plan is not None:
            self._plan, self._plan_age = plan, 0
            # A base that is held must not be asked for more and more: let go, it would leap.
            share = self._config.reentry.blocked_share if target.blocked_for else 1.0
            return _Outcome(self._inside(plan.commands[0], share), Mode.TRACKING, report, plan, target.blocked_for)
        notes.append(f"solve failed: {report.status}")
        self._plan_age += 1
        usable = min(self._config.failure.max_reused_ticks, self._config.horizon - 1)
        if self._plan is not None and self._plan_age <= usable:
            command = self._inside(self._plan.commands[self._plan_age])
            return _Outcome(command, Mode.REUSED_PLAN, report, self._plan)
        return self._brake(notes)._replace(solver=report)

    def _brake(self, notes: list[str], *reasons: str, failure: bool = True) -> _Outcome:
        notes.extend(reasons)
        self._plan = None
        self._planner.reset()
        # Waiting for the first pose is no failure to be latched.
        self._latched = self._latched or (failure and self._has_driven and not self._config.failure.resume)
        command = self._ramp()
        return _Outcome(command, Mode.BRAKING if command.any() else Mode.STOPPED)

    def _ramp(self) -> FloatArray:
        config = self._config
        return clip_command(np.zeros(2), config.limits, config.sample_time, self._last, braking=True)

    def _inside(self, command: FloatArray, share: float = 1.0) -> FloatArray:
        return clip_command(command, self._config.limits, self._config.sample_time, self._last, share)

    def _slew_base(self) -> FloatArray:
        """What the robot really got, as far as it lies inside the limits: from outside them there is no slew back."""
        return inside_limits(self._estimator.commands.last, self._config.limits, self._last)

    def _restart(self) -> bool:
        """Take the robot to be where its rejected poses agree it is, once it has been told to stand."""
        if self._estimator.commands.recent.any() or not self._config.failure.resume:
            return False
        return self._estimator.restart_elsewhere()
