"""Controller that passes measurements to the compiled tick and returns its result as arrays and messages.

`mpc/core/tick.c` implements the tick. This module connects the tick to the configuration, the prediction model, the
re-entry, the optional solver backend, the features and the message texts.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.errors import checked_methods, checked_number, wrong_type
from diffdrive_mpc.models.interface import CompiledTick, FloatArray, Measurement, Reference, checked_array
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.plug_ins import missing_part, plug_in_names
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.config_file import load_config, replace_values
from diffdrive_mpc.mpc.config.rooms import shown_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.generate import compile_functions
from diffdrive_mpc.mpc.core.tick import Tick
from diffdrive_mpc.mpc.estimate import Belief, Estimate
from diffdrive_mpc.mpc.features.feature import Feature, Host
from diffdrive_mpc.mpc.features.registry import enabled_features, feature_terms, prepare_config
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.messages import MessageFormatter
from diffdrive_mpc.mpc.problem.build import chosen_model, is_from_file, sampled_model
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS, SLACK, Problem
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.mpc.problem.terms import Term, all_terms, checked_parameters, checked_terms
from diffdrive_mpc.mpc.reentry import Pursuit, TooFar
from diffdrive_mpc.mpc.solver.backend import Backend, Program, load_backend, solve_all
from diffdrive_mpc.mpc.solver.costliest_limit import costliest_limit
from diffdrive_mpc.mpc.solver.quadratic_program import QuadraticProgram, quadratic_program
from diffdrive_mpc.mpc.solver.report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories.feasibility import Shortfall, find_shortfall
from diffdrive_mpc.mpc.trajectories.native import NativeReference
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds, checked_reference

_CHANGEABLE_GROUPS = ("weights", "limits")
_EXAMPLES = {"weights": "across", "limits": "v"}
# Values of `ddmpc_pending`.
_NEEDS_TARGET, _NEEDS_BACKEND = 1, 2
_MAX_COMMAND = 1e6
"""Maximum absolute value of applied commands [m/s, rad/s], far above the speed of any robot; squares stay finite."""


@dataclass
class _PredictionModel:
    """Prediction model of the controller, with its discrete form and its feed-forward."""

    model: VelocityModel | NonlinearModel
    sampled: DiscreteModel | NonlinearModel
    feed_forward: FeedForward

    @classmethod
    def from_model(cls, model: VelocityModel | NonlinearModel, dt: float) -> _PredictionModel:
        return cls(model, sampled_model(model, dt), FeedForward.from_model(model, dt))


@dataclass
class _PendingUpdate:
    """New configuration and the objects built from it, which the next step applies."""

    config: ControllerConfig
    constants: tuple[Any, list[FloatArray]]
    backend: Backend


@checked_methods
class Controller:
    """Model-predictive controller that tracks a timed reference.

    Parameters
    ----------
    config
        Configuration, or any other argument of `load_config`, such as "ssm".
    model
        Velocity model, or its name or path; replaces the model of the configuration. The extra dead time of the
        configuration is not added to this model.
    terms
        Cost terms and soft limits in addition to those of the configuration, see `mpc.problem.terms`.
    overrides
        Values of the configuration, such as ``horizon=20``; dotted keys as ``**{"weights.across": 200.0}``.

    Raises
    ------
    ConfigError, ModelError, ValueError
        If the configuration is invalid, the model cannot be loaded or used, or the horizon is shorter than the dead
        time.
    NotCompiledError
        If the core is not compiled and no compiler is available.
    ArgumentError
        If an argument has a wrong type.
    """

    def __init__(
        self,
        config: ControllerConfig | str | Path | Mapping[str, object],
        model: VelocityModel | NonlinearModel | str | Path | None = None,
        terms: Sequence[Term] = (),
        **overrides: object,
    ) -> None:
        # Features may change the configuration, so this call precedes everything that is derived from it.
        config, terms = prepare_config(load_config(config, overrides)), checked_terms(terms)
        # Stored without the terms of files and features, since `__setstate__` calls `__init__`, which adds them.
        self._arguments = model, terms
        self._speed_limit: float | None = None
        self._terms = all_terms(config.terms, (*terms, *feature_terms(config)))
        dt, active_model = config.sample_time, chosen_model(config, model)
        self._prediction = _PredictionModel.from_model(active_model, dt)
        # Unset weights on increments are derived from the sampled model, before the problem is built with them.
        self._config = config = with_increments(config, self._prediction.sampled)
        self._features: dict[str, Feature] = {
            name: feature_class(config, active_model) for name, feature_class in enabled_features(config).items()
        }
        problem = self._problem(config)
        sizes = problem.sizes
        functions, term_functions = compile_functions(active_model, self._terms)
        self._tick = Tick(sizes, problem.constants(), functions, term_functions)
        self._kinds, self._max_active = HARD_KINDS + sizes["soft"], sizes["max_active"]
        self._soft_names = problem.soft_names
        self._backend = self._make_backend(config)
        self._program = Program(self._tick, config.horizon, self._kinds)
        self._messages = MessageFormatter(self._tick, config)
        self._time_grid: FloatArray = np.asarray(np.arange(self._tick.samples) * dt)
        self._pursuit = Pursuit(
            config, self._tick.stray, lambda: costliest_limit(self._program, self._config, self._soft_names)
        )
        self._pending: _PendingUpdate | None = None
        self._reference: Reference | None = None
        self._t0, self._first_step = 0.0, math.nan
        self._blocked_for = 0.0
        defaults = [value for term in self._terms for value in term.defaults]
        self._tick.parameters[:] = np.array(defaults, dtype=float)
        self._host = Host(
            config,
            active_model,
            self._tick,
            self._pursuit,
            self._terms,
            # The function reads `_c_result` at the call, since it is assigned only below.
            is_new_tick=lambda: not self._c_result.reasons & self._messages.not_a_new_tick,
        )
        for feature in self._features.values():
            feature.attach(self._host)
        # Attribute access through cffi is slow, so the members that each tick uses are stored.
        self._step, self._c, self._c_result = self._tick.lib.ddmpc_step, self._tick.c, self._tick.result
        self._input = self._tick.input.struct
        self._not_run: int = self._tick.lib.DDMPC_QP_NOT_RUN

    @property
    def operations_bound(self) -> int:
        """Upper bound of `step.solver.operations`, computed from the horizon and the number of limits."""
        N = self._config.horizon
        return int(self._tick.lib.ddmpc_operations_bound(N, self._kinds, self._max_active))

    def _problem(self, config: ControllerConfig) -> Problem:
        prediction = self._prediction
        limited, from_file = _with_speed_limit(config, self._speed_limit), is_from_file(prediction.model)
        return Problem(limited, prediction.sampled, prediction.feed_forward, self._terms, from_file)

    def _make_backend(self, config: ControllerConfig) -> Backend:
        return load_backend(config.solver.backend)(config.horizon, self._kinds, config.solver, config.weights)

    def __repr__(self) -> str:
        """Describe the prediction model and the reference in one line."""
        config, model, reference = self._config, self.model, self._reference
        reference_name = "nothing yet" if reference is None else repr(reference.name)
        return (
            f"Controller with model {model.name!r}, {config.horizon} steps of {config.sample_time:g} s ahead, tracking "
            f"{reference_name}"
        )

    def __getstate__(self) -> dict[str, object]:
        """Return configuration, model, terms and reference for a process pool; the state of the drive is omitted.

        A warning is issued during a drive.
        """
        if self._reference and not math.isnan(self._first_step) and self._pursuit.time < self._reference.duration:
            lost = "its estimate, plan and commands are not copied"
            warnings.warn(f"a copy of a controller starts its drive anew: {lost}", stacklevel=2)
        return {
            "config": self._pending.config if self._pending else self._config,
            "arguments": self._arguments,
            "parameters": self._tick.parameters.copy(),
            "speed_limit": self._speed_limit,
            "reference": self._reference,
            "t0": self._t0,
            "features": {name: feature.state() for name, feature in self._features.items()},
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild the controller in another process, in the state after `start`."""
        Controller.__init__(self, state["config"], *state["arguments"])
        self._tick.parameters[:] = state["parameters"]
        self.limit_speed(state["speed_limit"])
        for name, feature_state in state["features"].items():
            self._features[name].restore(feature_state)
        if state["reference"] is not None:
            # No second check: the reference was checked at the start, and limits may have been tightened since then.
            self._begin(state["reference"], state["t0"])

    @property
    def config(self) -> ControllerConfig:
        """Current configuration, including the weights derived from the margin."""
        return self._config

    @property
    def sample_time(self) -> float:
        """Period at which `step` is called [s]."""
        return self._config.sample_time

    @property
    def model(self) -> VelocityModel | NonlinearModel:
        """Velocity model, including the extra dead time."""
        return self._prediction.model

    @property
    def program(self) -> Program:
        """Quadratic program of the last solve; a view of the core's memory."""
        return self._program

    def quadratic_program(self, plan: ArrayLike | None = None) -> QuadraticProgram:
        """Return a copy of the last tick's program with all limits, for OSQP and other QP solvers.

        Parameters
        ----------
        plan
            (N, 2) commands v_ref [m/s], omega_ref [rad/s] along which to linearise; None keeps the last linearisation.

        Raises
        ------
        RuntimeError
            If no tick has set up a program yet, or `plan` is not None and the last step has no new plan.
        ValueError
            If the plan is not N pairs of finite numbers.
        """
        # The core's memory is initialised with zeros, while H of a program has positive weights on its diagonal.
        if not self._program.H.any():
            raise RuntimeError("there is no quadratic program yet: call start, and step with poses until TRACKING")
        if plan is not None:
            self._fresh_estimate()
            pairs = _pairs(plan)
            if len(pairs) != self._config.horizon:
                raise ValueError(f"plan: {len(pairs)} pairs; give one for each of the {self._config.horizon} steps")
            self._program.linearise(np.ascontiguousarray(pairs))
        return quadratic_program(self._program, self._config.weights, self._soft_names)

    def problem_inputs(self) -> dict[str, FloatArray]:
        """Return the inputs of `CasadiProblem` at the last tick, by name.

        Turning points and bounds are those of the last linearisation, see `quadratic_program`. For shapes see
        `CasadiProblem`.

        Raises
        ------
        RuntimeError
            If the last step has no new plan.
        """
        estimate, belief, p = self._fresh_estimate(), self.belief, self._program
        bounds = np.stack([p.lower, p.upper])
        # The core subtracts the values at a zero plan from the soft bounds; `CasadiProblem` limits the full values.
        bounds[:, HARD_KINDS:] += p.soft_values
        return {
            "state": estimate.state,
            "pose": estimate.pose,
            "slip": estimate.mean[belief.slips],
            "sent": belief.sent.T,
            "late": p.late.copy(),
            "last_command": p.last_command.copy(),
            "reference": p.aim.T.copy(),
            "feed_forward": np.vstack([p.fed_before, p.feed_forward]).T,
            "ahead": p.ahead[None].copy(),
            "direction": p.directions,
            "parameters": self._tick.parameters.T.copy(),
            "lower": bounds[0],
            "upper": bounds[1],
        }

    def _fresh_estimate(self) -> Estimate:
        if self._c_result.mode != self._tick.lib.DDMPC_TRACKING:
            raise RuntimeError("the last step has no new plan: call step until its mode is TRACKING")
        return Estimate(self._tick.layout, self._tick.layout.copy(), self._c_result.estimate.time)

    @property
    def reference(self) -> Reference | None:
        """Current reference."""
        return self._reference

    @property
    def planned_delay(self) -> float:
        """Part of `StepResult.reference_delay` that is caused by a waiting reference, speed limits and obstacles [s].

        The lag of the robot is not included.
        """
        return self._pursuit.planned_delay

    @property
    def features(self) -> Mapping[str, Feature]:
        """Attached features by name."""
        return MappingProxyType(self._features)

    def feature(self, name: str) -> Any:  # noqa: ANN401 - each feature has its own methods
        """Return an attached feature by its name.

        Raises
        ------
        ConfigError
            If the configuration does not enable the feature; the message names the package if the feature is not
            installed.
        """
        if name in self._features:
            return self._features[name]
        if name in plug_in_names("features"):
            raise ConfigError(f"feature '{name}' is not enabled: set {shown_key(f'{name}.enabled')} to true")
        raise ConfigError(missing_part("features", name))

    @property
    def belief(self) -> Belief:
        """Copy of the filter's belief at the last step.

        Raises
        ------
        RuntimeError
            If there is no estimate because no pose was accepted since the last `start`.
        """
        newest = self._tick.newest_belief()
        if newest is None:
            raise RuntimeError("there is no estimate yet: call step with a pose first")
        return Belief(*newest, self._tick.layout.slip.start)

    def predict_belief(self, belief: Belief, commands: ArrayLike) -> Belief:
        """Predict the filter's belief without measurements, including the future pose and its uncertainty.

        The prediction uses the process model of the estimator, including noise and random walks.

        Parameters
        ----------
        belief
            Initial belief, possibly modified or from an earlier tick.
        commands
            (K, 2) v_ref [m/s], omega_ref [rad/s], one row per sample, starting at the tick of the belief.

        Returns
        -------
        Belief
            Belief K samples later.

        Raises
        ------
        ValueError
            If a command is not finite or exceeds 1e6, or the shape is wrong.
        """
        pairs = _pairs(commands)
        # The prediction of the first sample also needs the pending commands.
        commands = np.vstack([belief.sent, pairs])
        mean, covariance = self._tick.predict_belief(belief.mean, belief.covariance, commands)
        return replace(belief, mean=mean, covariance=covariance, sent=commands[len(pairs) :])

    def set_applied_commands(self, commands: ArrayLike) -> None:
        """Replace the last K commands by the commands that were actually sent, for instance by another controller.

        The next step uses these commands for the estimate, for the dead time, and for the slew limit, which is relative
        to the newest command. To shadow another controller, pass its command after each step. For a robot that already
        moves, pass several commands before the first step.

        Parameters
        ----------
        commands
            (K, 2) v_ref [m/s], omega_ref [rad/s], oldest first, one row per sample; they may exceed the limits.

        Raises
        ------
        ValueError
            If a command is not finite or exceeds 1e6, or the shape is wrong.
        """
        pairs = _pairs(commands)
        if not len(pairs):
            return
        self._tick.set_applied_commands(pairs)
        for feature in self._features.values():
            feature.set_applied(pairs[-1])

    def start(self, reference: Reference | str | Path, t0: float) -> None:
        """Start to track `reference`, whose time 0 is `t0` [s] on the clock of `step`.

        The estimate and the clock restart. The robot may be moving: commands in the dead time are kept, and the next
        command respects the slew limit relative to the last command. A name or path selects a trajectory, which is
        loaded with the limits of the configuration.

        Raises
        ------
        ArgumentError
            If the reference has a wrong type.
        ValueError
            If `t0` or the reference is not finite, or if the speeds of the reference or the commands for these speeds
            exceed the limits of the configuration.
        """
        self._begin(self.checked_reference(reference, t0), t0)

    def checked_reference(self, reference: Reference | str | Path, t0: float = 0.0) -> Reference:
        """Load a trajectory if `reference` is a name or path, and apply the checks of `start`.

        Raises
        ------
        ArgumentError, ValueError
            If the reference is invalid, see `start`.
        """
        reference = self._loaded(reference)
        self._check(reference, t0)
        return reference

    def _loaded(self, reference: Reference | str | Path) -> Reference:
        if not isinstance(reference, (str, Path)):
            return reference
        from diffdrive_mpc.mpc.trajectories.load import load_trajectory  # noqa: PLC0415 - rarely needed

        return load_trajectory(reference, self._config)

    def find_shortfall(self, reference: Reference | str | Path, *, is_moving: bool = False) -> Shortfall | None:
        """Find the first point where `reference` exceeds the robot's limits, and a feasible duration.

        The robot starts at rest, or with the twist of the reference if `is_moving` is True. The result is None if the
        reference is feasible. `start` does not call this method and accepts infeasible references.
        """
        return find_shortfall(self._loaded(reference), self._config, self.model, is_moving=is_moving)

    def _check(self, reference: Reference, t0: float) -> None:
        if not isinstance(reference, Reference):
            remedy = "create one with load_trajectory('circle') or Trajectory.from_arrays(t, x, y)"
            raise wrong_type("reference", "a trajectory", reference, remedy)
        t0 = checked_number("start time t0", t0, "give seconds on the clock of step, such as 0.0")
        if not math.isfinite(t0):
            raise ValueError(f"t0 = {t0}: the start time must be finite")
        check_speeds(reference, self._config.limits, self._config.sample_time, self.model.dc_gain)

    def _begin(self, reference: Reference, t0: float) -> None:
        """Start to track a checked reference."""
        tracked = reference
        for feature in self._features.values():
            tracked = feature.start(tracked, t0)
        native, tracked = self._prepare_reference(tracked)
        self._tick.lib.ddmpc_start(self._c, native.struct, t0)
        # The native reference must stay alive, since the core reads its memory.
        self._tick.reference, self._reference = native, reference
        self._set_start_time(t0)
        self._pursuit.start(tracked, native=native.complete)

    def _set_start_time(self, t0: float) -> None:
        self._t0 = self._host.t0 = t0
        # Time of the first step since then, for the message about a clock that differs from that of `t0`.
        self._first_step = math.nan

    def _prepare_reference(self, reference: Reference) -> tuple[NativeReference, Reference]:
        """Apply the features to a reference; return the reference in the form of the core and as a Python object."""
        tracked = checked_reference(reference)
        for feature in self._features.values():
            tracked = feature.modify_reference(tracked)
        return NativeReference(tracked), tracked

    def switch_reference(self, reference: Reference | str | Path, t0: float | None = None) -> None:
        """Replace the current reference by `reference` while driving.

        Unlike `start`, this method keeps the estimate including the learned slip, the plan and the commands. A robot
        off the new path rejoins the path. If an enabled feature does not support a switch, the drive restarts as with
        `start`.

        Parameters
        ----------
        reference
            The current reference transformed by a pose, for example after a frame correction; or a different reference,
            or its name or path, which requires `t0`.
        t0
            Time 0 of a different reference on the clock of `step` [s]; None for the transformed current reference,
            whose clock continues.

        Raises
        ------
        ValueError
            If `t0` is None and the duration differs from that of the current reference, or if `t0` is given and `start`
            would reject the reference.
        RuntimeError
            If no reference is being tracked.
        """
        if self._reference is None:
            raise RuntimeError("no reference: call start(reference, t0) before switch_reference")
        reference = self._loaded(reference)
        if t0 is not None:
            self._check(reference, t0)
        elif reference.duration != self._reference.duration:
            raise ValueError("the duration of the reference differs from that of the current reference: give t0")
        if any(feature.restarts_on_switch for feature in self._features.values()):
            self.start(reference, self._t0 if t0 is None else t0)
            return
        native, tracked = self._prepare_reference(reference)
        if t0 is not None:
            self._set_start_time(t0)
        self._tick.lib.ddmpc_switch_reference(self._c, native.struct, self._t0)
        # The native reference must stay alive, since the core reads its memory.
        self._tick.reference, self._reference = native, reference
        if t0 is None:
            self._pursuit.switch_reference(tracked, native=native.complete)
        else:
            self._pursuit.start(tracked, native=native.complete)

    def reset(self) -> None:
        """Reset the estimate, plan and commands of a robot at standstill; the reference is kept."""
        self._tick.lib.ddmpc_reset(self._c)
        self._pursuit.restart()
        for feature in self._features.values():
            feature.reset()

    @property
    def is_latched(self) -> bool:
        """True while the robot waits for `start` or `resume` after a failure.

        The robot waits after an outage or a jump of the clock longer than `failure.resume_within`, after a jump of the
        poses beyond `failure.max_position_error`, and, if `failure.resume` is false, after every failure.
        """
        return bool(self._tick.lib.ddmpc_is_latched(self._c))

    def resume(self) -> None:
        """Continue along the waiting reference after a latched failure, see `is_latched`."""
        self._tick.lib.ddmpc_resume(self._c)

    def update(
        self, weights: Mapping[str, float] | None = None, limits: Mapping[str, float] | None = None
    ) -> ControllerConfig:
        """Change weights and limits while driving; they take effect at the start of the next step.

        This method builds the derived objects, so that `step` only applies them. If a limit is tightened below the
        current command, the command approaches it at the slew limit.

        Returns
        -------
        ControllerConfig
            Configuration from the next step on. A warning is issued if the rest of the reference exceeds the limits.

        Raises
        ------
        ConfigError
            If a key is unknown or a value is out of range; the configuration then stays unchanged.
        ArgumentError
            If `weights` or `limits` is not a mapping.
        """
        config = self.updated(weights, limits)
        self._prepare_limits(config)
        if limits and self._reference is not None and self._pursuit.time < self._reference.duration:
            try:
                check_speeds(self._reference, config.limits, config.sample_time, self.model.dc_gain, self._pursuit.time)
            except ValueError as error:
                warnings.warn(f"the robot will lag behind its reference: {error}", stacklevel=3)
        return config

    def updated(
        self, weights: Mapping[str, float] | None = None, limits: Mapping[str, float] | None = None
    ) -> ControllerConfig:
        """Return the configuration that `update` would apply, without applying it.

        Raises
        ------
        ConfigError, ArgumentError
            If an argument is invalid, as for `update`.
        """
        for group, values in zip(_CHANGEABLE_GROUPS, (weights, limits), strict=True):
            if not isinstance(values, (Mapping, type(None))):
                raise wrong_type(group, "values by key", values, f"write update({group}={{'{_EXAMPLES[group]}': 1.0}})")
        changes = {
            f"{group}.{key.removeprefix(f'{group}.')}": value
            for group, values in zip(_CHANGEABLE_GROUPS, (weights, limits), strict=True)
            for key, value in (values or {}).items()
        }
        # Consecutive changes between two steps accumulate.
        config = replace_values(self._pending.config if self._pending else self._config, changes)
        config = with_increments(config, self._prediction.sampled)
        # Each of these limits adds rows to the program, whose size is fixed at construction.
        for name in ("min_turn_radius", "min_commanded_radius"):
            if (getattr(config.limits, name) is None) != (getattr(self._config.limits, name) is None):
                raise ConfigError(
                    f"limits.{name}: this limit can be changed while driving, but it cannot be added or removed; set "
                    "it in the configuration"
                )
        return config

    def _prepare_limits(self, config: ControllerConfig) -> None:
        constants = self._tick.prepare(self._problem(config).constants())
        self._pending = _PendingUpdate(config, constants, self._make_backend(config))

    @property
    def speed_limit(self) -> float | None:
        """Additional speed limit set by `limit_speed` [m/s]; None if there is no additional limit."""
        return self._speed_limit

    def limit_speed(self, v: float | None) -> None:
        """Limit the speed to `v` [m/s] from the next step on, as in a speed zone; None removes the limit.

        The limit is a hard limit on |v_ref|, which the command approaches at the slew limit, and a soft limit on the
        predicted speed. If the reference is faster, its clock slows down and catches up afterwards. If
        `reentry.enabled` is false, the clock continues and the robot falls behind. References are still checked
        against the limits of the configuration.

        Raises
        ------
        ValueError
            If `v` is not a positive finite number.
        """
        if v is not None and not (math.isfinite(v) and v > 0.0):
            raise ValueError(f"speed limit of {v} m/s: give a positive number, or None for no limit")
        if v == self._speed_limit:
            return
        self._speed_limit = v
        self._pursuit.limit_speed(v)
        self._prepare_limits(self._pending.config if self._pending else self._config)

    def set_parameters(self, **values: ArrayLike) -> None:
        """Set the stage parameters of terms by term name; they take effect at the next step.

        Parameters
        ----------
        values
            (p,) parameters of a term for all samples, or (N + 1, p) parameters for the samples 0 to N.

        Raises
        ------
        ConfigError
            If a term does not exist, a shape is wrong, or a value is not finite; all parameters then stay unchanged.
        """
        table = self._tick.parameters
        for columns, rows in checked_parameters(self._terms, len(table), values):
            table[:, columns] = rows

    def step(
        self,
        t: float,
        measurement: Measurement,
        hold: Hold | None = None,
        *,
        deadline: float | None = None,
        most_iterations: int | None = None,
    ) -> StepResult:
        """Compute the command for the tick at `t` [s] from the measurements since the last tick.

        Invalid measurements never raise an error. A measurement that is not finite, jumps or is too old is rejected
        with a note in `message`, and the controller dead-reckons. The robot brakes if no pose was accepted for
        `failure.max_pose_age`, or for `failure.dead_reckoning` if wheels and gyro are available. With `hold` the robot
        brakes to a standstill, and the estimate is still updated. If `t` leaps by more than `estimator.history`, the
        command becomes zero in one tick, since the command timeout of the base has already stopped the robot. All other
        changes of the command respect the slew or the braking limits.

        `deadline` [s, `time.monotonic`] is the time at which the solve stops; results then depend on the speed of the
        computer. The active set performs at least one iteration. Its plan respects ranges and slew but may violate
        other limits, which `solver.status` reports. A backend that reaches the deadline returns no plan, and it does
        not start if its factorisation is expected to exceed the deadline. After `solver.max_missed` consecutive missed
        deadlines the robot brakes. `most_iterations` reproduces a tick that missed its deadline (`solver.missed`): it
        is the maximum number of iterations of the active set; with 0 no backend is used.

        Raises
        ------
        RuntimeError
            If `start` was not called.
        ArgumentError
            If `measurement` is not a `Measurement`.
        """
        start = time.perf_counter()
        if self._reference is None:
            raise RuntimeError("no reference: call start(reference, t0) before step")
        if self._pending is not None:
            self._apply_pending(self._pending)
        tick, pursuit, tick_input = self._tick, self._pursuit, self._input
        try:
            tick.input.fill(measurement)
        except AttributeError as error:
            remedy = "call step(t, Measurement(...)), or step(t, Measurement()) if there are no new data"
            raise wrong_type("measurement", "a Measurement", measurement, remedy) from error
        if not (hold is None or isinstance(hold, Hold)):
            raise wrong_type("hold", "a Hold or None", hold, "write hold=Hold(reason)")
        for feature in self._features.values():
            hold = feature.before_step(t) or hold
        # Values of `ddmpc_request`.
        tick_input.request = 0 if hold is None else 3 if hold.waits else 2 if hold.failure else 1
        # Only the replay of a late tick passes a number of iterations.
        tick_input.is_late = most_iterations is not None
        try:
            tick_input.deadline, tick_input.most_iterations = deadline or 0.0, most_iterations or 0
            since_start = t - self._t0
        except TypeError as error:
            remedy = "call step(t, Measurement(...))"
            for name, value in (("t", t), ("deadline", deadline or 0.0)):
                checked_number(name, value, remedy)
            raise wrong_type("most_iterations", "an integer", most_iterations, remedy) from error
        if math.isnan(self._first_step):
            self._first_step = since_start
        on_time = pursuit.on_time and since_start >= 0.0
        # The reference's clock advances once per tick, but not at a repeated call or at an invalid time.
        has_advanced = not on_time and bool(tick.lib.ddmpc_is_new_tick(self._c, t))
        tick_input.reference_time = pursuit.advance(since_start) if has_advanced else since_start
        tick_input.on_time = on_time
        pending = self._step(self._c, t, tick_input)
        # In a replay, 0 iterations represent a backend that found no solution in time, hence a deadline in the past.
        result = self._complete(
            pending, since_start, start, hold, 0.0 if most_iterations == 0 else deadline, has_advanced=has_advanced
        )
        for feature in self._features.values():
            result = feature.after_step(t, measurement, result)
        # The step time includes the computation time of the features.
        return replace(result, step_time=time.perf_counter() - start) if self._features else result

    def _complete(
        self,
        pending: int,
        since_start: float,
        start: float,
        hold: Hold | None = None,
        deadline: float | None = None,
        *,
        has_advanced: bool = False,
    ) -> StepResult:
        """Complete the tick of the last step in C; `pending` is its return value, `start` the time of the call."""
        pursuit, tick_input, message = self._pursuit, self._input, ""
        if pending == _NEEDS_TARGET:
            # The robot was on time until this tick, so `step` has not advanced the reference's clock.
            if not has_advanced:
                tick_input.reference_time = pursuit.advance(since_start)
            pending, message = self._choose_target(since_start, tick_input.reference_time)
        elif tick_input.on_time:
            c = self._c_result
            if not c.reasons & self._messages.not_a_new_tick:
                self._record_on_time(since_start, tracked=pending == _NEEDS_BACKEND or c.solver.status != self._not_run)
        # The core has braked or finished; a robot without a motion command is not blocked.
        elif has_advanced:
            self._blocked_for = 0.0
        is_refused, solve_time = False, self._c_result.solve_time
        if pending == _NEEDS_BACKEND:
            backend_start = time.perf_counter()
            is_refused = self._solve_with_backend(deadline)
            solve_time += time.perf_counter() - backend_start
        message = message or self._describe_start(since_start)
        return self._build(hold, message, (start, solve_time), is_refused=is_refused)

    def _describe_start(self, since_start: float) -> str:
        """Return a message if the reference begins after this step or ended before the first step, else ""."""
        # At an invalid time the clock itself is reported.
        if since_start < 0.0 and not self._c_result.reasons & self._messages.not_a_new_tick:
            return f"the reference begins in {-since_start:.4g} s, at t0: start and step need the same clock"
        overdue = self._first_step - (self._reference.duration if self._reference else math.inf)
        if overdue > 0.0 and self._c_result.mode == self._tick.lib.DDMPC_FINISHED:
            return f"the reference ended {overdue:.4g} s before the first step: give start a t0 on the clock of step"
        return ""

    def _record_on_time(self, since_start: float, *, tracked: bool) -> None:
        self._blocked_for = 0.0
        self._pursuit.record_on_time(since_start, tracked=tracked)

    def compiled_tick(self) -> CompiledTick:
        """Return the C tick for a simulation, see `models.interface.CompiledTick`; call `start` first."""
        layout, lib, pursuit, steps = self._tick.layout, self._tick.lib, self._pursuit, {}
        # A simulation starts at its first step.
        self._first_step = 0.0
        command, estimate = layout.take(layout.live, "command"), Estimate(layout, layout.live, 0.0)
        for method in (lib.DDMPC_UNLIMITED, lib.DDMPC_ACTIVE_SET):
            report = SolverReport(SolverStatus.SOLVED, self._messages.method(method), 0, 0.0, 0.0)
            steps[method] = StepResult(command, Mode.TRACKING, "", report, 1.0, 0.0, estimate, 0.0, math.nan)

        def is_next() -> bool:
            self._input.request = self._input.most_iterations = self._input.is_late = 0
            self._input.deadline, self._input.on_time = 0.0, 1
            is_plain = not self._features and self._pending is None and type(self).step is Controller.step
            return is_plain and pursuit.on_time

        def record(t: float) -> None:
            self._messages.cause = ""
            self._record_on_time(t - self._t0, tracked=True)

        def complete(t: float, pending: int) -> StepResult:
            return self._complete(pending, t - self._t0, time.perf_counter())

        return CompiledTick(self._tick.addresses(), self._t0, steps, is_next, record, complete)

    def _apply_pending(self, update: _PendingUpdate) -> None:
        self._config, self._backend, self._pending = update.config, update.backend, None
        self._tick.configure(update.constants)
        self._messages.configure(update.config)
        self._pursuit.configure(update.config)
        self._host.config = update.config
        for feature in self._features.values():
            feature.configure()

    def _choose_target(self, since_start: float, reference_time: float) -> tuple[int, str]:
        """Choose the target of a robot that is off its path or late.

        Returns the value of `ddmpc_pending` after the choice, and a message.
        """
        tick = self._tick
        estimate = Estimate(tick.layout, tick.layout.copy(), self._c_result.estimate.time)
        self._blocked_for = 0.0
        try:
            target = self._pursuit.target(since_start, reference_time, estimate, self._time_grid, self._c_result.reach)
            if isinstance(target, TooFar):
                return tick.lib.ddmpc_too_far(self._c, target.distance), ""
            self._blocked_for = target.blocked_for
            sample = target.sample or target.reference.sample(target.time + self._time_grid)
            # Commands to a blocked base are reduced, so that the robot does not jerk when it comes free.
            share = self._config.reentry.blocked_share if target.blocked_for else 1.0
            return tick.track(sample.pose, sample.twist, share), target.message
        except (ArithmeticError, ValueError) as error:
            # The samples of the reference are invalid; a drive must not raise, so use the rest of the last plan.
            return tick.lib.ddmpc_give_up(self._c), f"the reference cannot be sampled: {error}"

    def _solve_with_backend(self, deadline: float | None) -> bool:
        """Solve with the backend and pass the result to the core; return True if the backend rejected the program."""
        tick, solver = self._tick, self._config.solver
        solution, report = solve_all(self._backend, self._program, solver.backend, SLACK * solver.tolerance, deadline)
        ffi = tick.ffi
        plan, multipliers = (
            ffi.from_buffer("real[]", np.ascontiguousarray(values)) for values in (solution.plan, solution.multipliers)
        )
        is_refused = report.status is SolverStatus.REFUSED
        # `ddmpc_solver_status` has no value for a rejected program.
        status = SolverStatus.NOT_RUN if is_refused else report.status
        core_report = {
            "status": getattr(tick.lib, f"DDMPC_QP_{status.name}"),
            "path": tick.lib.DDMPC_BACKEND,
            "iterations": report.iterations,
            "soft_limits": report.soft_limits,
            "primal_residual": report.primal_residual,
            "dual_residual": report.dual_residual,
        }
        tick.lib.ddmpc_answer(self._c, plan, multipliers, ffi.new("ddmpc_report *", core_report))
        return is_refused

    def _build(self, hold: Hold | None, message: str, times: tuple[float, float], *, is_refused: bool) -> StepResult:
        """Build the step result from the C result; `times` are the start of the call and the solve time [s]."""
        c, pursuit = self._c_result, self._pursuit
        layout = self._tick.layout
        block = layout.copy()
        c_report = c.solver
        status = SolverStatus.REFUSED if is_refused else self._messages.statuses[c_report.status]
        report = SolverReport(
            status,
            self._messages.method(c_report.path),
            c_report.iterations,
            c_report.primal_residual,
            c_report.dual_residual,
            bool(c_report.soft_limits),
            c_report.operations,
            c_report.missed,
        )
        if c.reasons or c.notes or message:
            message = self._messages.sentence(hold, status, message)
        else:
            self._messages.cause = ""
        return StepResult(
            layout.take(block, "command"),
            self._messages.modes[c.mode],
            message,
            report,
            pursuit.progress,
            pursuit.delay,
            Estimate(layout, block, c.estimate.time) if c.has_estimate else None,
            self._blocked_for,
            time.perf_counter() - times[0],
            times[1],
            (layout, block) if c.has_plan else None,
            self._messages.unused(c.reasons) if c.reasons else (),
            is_late=pursuit.is_late,
            limited_by=pursuit.limit,
        )


def _with_speed_limit(config: ControllerConfig, speed: float | None) -> ControllerConfig:
    """Return `config` with its speed limits reduced to at most `speed` [m/s]."""
    limits = config.limits
    if speed is None or speed >= max(limits.v.sides):
        return config
    reduced = {"v": limits.v.map(lambda side: min(side, speed)), "predicted_v": min(limits.predicted_v, speed)}
    return config.model_copy(update={"limits": limits.model_copy(update=reduced)})


def _pairs(commands: ArrayLike) -> FloatArray:
    """Convert commands to an array (K, 2); raise ValueError for a wrong shape or invalid values."""
    remedy = "give an array (K, 2) of v_ref [m/s], omega_ref [rad/s]"
    pairs = checked_array("commands", commands, "pairs of numbers", remedy)
    # The comparison is negated so that NaN fails.
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not (np.abs(pairs) <= _MAX_COMMAND).all():
        raise ValueError(
            f"commands of shape {pairs.shape}: give finite pairs (K, 2) of v_ref [m/s], omega_ref [rad/s], each at "
            f"most {_MAX_COMMAND:g}"
        )
    return pairs
