"""The controller: one tick straight down from measurement to command, and what happens when a part of it fails."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np

from models.interface import FloatArray, Measurement, Reference
from models.load import load_model
from models.velocity_model import VelocityModel
from mpc.bounds import clip_command
from mpc.config import ControllerConfig
from mpc.config_file import replace_values
from mpc.estimator import StateEstimator
from mpc.planner import Plan, Planner
from mpc.solver_report import SolverReport, SolverStatus
from mpc.step_result import Mode, StepResult

_NOT_RUN = SolverReport(SolverStatus.NOT_RUN)
_CHANGEABLE = ("weights", "limits")


class Controller:
    """Tracks a timed reference with a velocity model.

    Parameters
    ----------
    config
        The configuration, see `mpc.load_config`.
    model
        A velocity model or the name of one, instead of the configuration's.

    Raises
    ------
    models.checked_yaml.ConfigError, models.velocity_model.ModelError, ValueError
        If the model cannot be loaded or used, or the horizon is too short for the dead time.
    """

    def __init__(self, config: ControllerConfig, model: VelocityModel | str | None = None) -> None:
        chosen = model if isinstance(model, VelocityModel) else load_model(model or config.model)
        extra = config.extra_dead_time
        self._model = chosen.with_extra_dead_time([extra.v, extra.omega])
        self._config = config
        self._pending: ControllerConfig | None = None
        self._estimator = StateEstimator(self._model.discretise(config.sample_time), config.estimator)
        self._planner = Planner(config, self._model)
        self._reference: Reference | None = None
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
    def reference(self) -> Reference | None:
        """The reference being tracked."""
        return self._reference

    def start(self, reference: Reference, t0: float) -> None:
        """Track `reference` from now on; its time 0 is `t0` [s] on the clock of `step`.

        Raises
        ------
        ValueError
            If `t0` is not finite.
        """
        if not math.isfinite(t0):
            raise ValueError(f"t0 = {t0}: the start time must be finite")
        self.reset()
        self._reference, self._t0 = reference, t0

    def reset(self) -> None:
        """Forget estimate, plan and history; the reference stays, its clock too."""
        self._estimator.reset()
        self._planner.reset()
        self._plan: Plan | None = None
        self._plan_age = 0
        self._last_time = -math.inf
        self._latched = False
        self._finished = False

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

    def step(self, t: float, measurement: Measurement) -> StepResult:
        """Decide the command for the tick at `t` [s] from what arrived since the last one.

        Never raises on data: a measurement that is not finite, jumps or is too old is rejected and `message` says so;
        the robot dead-reckons, and brakes when no pose was accepted for `failure.max_pose_age`.

        Raises
        ------
        RuntimeError
            If `start` was not called.
        """
        started = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("no reference: call start(reference, t0) before step")
        self._apply_pending()
        notes: list[str] = []
        solver, plan = _NOT_RUN, None
        clock = self._check_clock(t)
        if clock:
            command, mode = self._brake([clock], notes)
        else:
            self._estimate(t, measurement, notes)
            command, mode, solver, plan = self._decide(t, self._reference, notes)
        command = np.where(np.isfinite(command), command, 0.0)
        self._estimator.commands.append(command)
        return StepResult(
            command=command,
            mode=mode,
            message="; ".join(notes),
            solver=solver,
            plan=None if plan is None else plan.poses,
            planned_commands=None if plan is None else plan.commands,
            estimate=self._estimator.estimate if self._estimator.ready else None,
            step_time=time.perf_counter() - started,
        )

    def _apply_pending(self) -> None:
        if self._pending is None:
            return
        self._config, self._pending = self._pending, None
        self._planner = Planner(self._config, self._model)

    def _check_clock(self, t: float) -> str:
        """What is wrong with the time of this tick, if anything."""
        if not math.isfinite(t):
            return f"the time of this tick is {t}; it was not used"
        if t <= self._last_time:
            return f"time ran backwards by {self._last_time - t:.3f} s; call start again if the clock was set"
        self._last_time = t
        return ""

    def _estimate(self, t: float, measurement: Measurement, notes: list[str]) -> None:
        notes.extend(self._estimator.correct_sent(measurement.sent))
        pause = self._estimator.advance(t)
        if pause:
            notes.append(pause)
        notes.extend(self._estimator.update(t, measurement))

    def _decide(
        self, t: float, reference: Reference, notes: list[str]
    ) -> tuple[FloatArray, Mode, SolverReport, Plan | None]:
        if not self._estimator.ready:
            return (*self._brake(["no pose has arrived yet"], notes), _NOT_RUN, None)
        estimate = self._estimator.estimate
        limit = self._config.failure.max_pose_age
        if estimate.pose_age > limit and not self._restart(t):
            return (*self._brake([f"no pose was accepted for {estimate.pose_age:.2f} s"], notes), _NOT_RUN, None)
        if self._latched:
            return (*self._brake(["stopped after a failure; call start or reset to drive on"], notes), _NOT_RUN, None)
        if self._is_finished(t - self._t0, reference, notes):
            return self._ramp(), Mode.FINISHED, _NOT_RUN, None
        return self._track(t, reference, notes)

    def _track(
        self, t: float, reference: Reference, notes: list[str]
    ) -> tuple[FloatArray, Mode, SolverReport, Plan | None]:
        commands = self._estimator.commands
        plan, report = self._planner.plan(self._estimator.estimate, commands.recent, reference, t - self._t0)
        if plan is not None:
            self._plan, self._plan_age = plan, 0
            return self._inside(plan.commands[0]), Mode.TRACKING, report, plan
        notes.append(f"solve failed: {report.status}")
        self._plan_age += 1
        usable = min(self._config.failure.max_reused_ticks, self._config.horizon - 1)
        if self._plan is not None and self._plan_age <= usable:
            return self._inside(self._plan.commands[self._plan_age]), Mode.REUSED_PLAN, report, self._plan
        return (*self._brake([], notes), report, None)

    def _brake(self, reasons: list[str], notes: list[str]) -> tuple[FloatArray, Mode]:
        notes.extend(reasons)
        self._plan = None
        self._planner.reset()
        # Waiting for the first pose is no failure to be latched.
        self._latched = self._latched or (self._estimator.ready and not self._config.failure.resume)
        command = self._ramp()
        return command, Mode.BRAKING if command.any() else Mode.STOPPED

    def _ramp(self) -> FloatArray:
        return self._inside(np.zeros(2))

    def _inside(self, command: FloatArray) -> FloatArray:
        return clip_command(command, self._config.limits, self._config.sample_time, self._estimator.commands.last)

    def _restart(self, t: float) -> bool:
        """Take the robot to be where its rejected poses agree it is, once it has stopped."""
        if self._estimator.commands.recent.any() or not self._config.failure.resume:
            return False
        return self._estimator.restart_from_candidate(t)

    def _is_finished(self, since_start: float, reference: Reference, notes: list[str]) -> bool:
        if self._finished or since_start < reference.duration:
            return self._finished
        finish, estimate = self._config.finish, self._estimator.estimate
        end = reference.sample([reference.duration]).pose[0]
        distance = float(np.hypot(*(estimate.pose - end)[:2]))
        settled = distance <= finish.position and (np.abs(estimate.twist) <= finish.speed).all()
        late = since_start >= reference.duration + finish.timeout
        if late and not settled:
            notes.append(f"finished {distance:.3f} m from the end, not at rest within {finish.timeout} s")
        self._finished = bool(settled or late)
        return self._finished
