"""Constants of a controller, by the names of their fields in C (`mpc/core/core.h`).

Python writes the constants to memory; an exported library contains the constants as C source.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import CompiledStep, NonlinearModel
from diffdrive_mpc.mpc.config.fixed_values import AHEAD, BEHIND, STANDING, TURNING
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.slip import CURVED_SLIPS, FLAT_SLIPS, PRIORS, SLIPS, Slip
from diffdrive_mpc.mpc.problem.terms import Term

Constants = dict[str, object]
"""Numbers and arrays by the name of the field in C."""

BUILT_IN_SOFT = ("v", "omega", "right", "left", "across")
"""Built-in kinds of soft limits, in the order of the core."""
PADDING = 8
"""Rows are padded with zeros to a multiple of this number of columns, equal to PADDING in mpc/core/internal.h."""
SLACK = 0.1
"""Share of the solver's tolerance up to which an exceeded limit counts as satisfied [-]."""
_MAX_CURVED_DEVIATIONS = 5.0
"""Bound of the estimate of curved slip relative to its initial value, in initial standard deviations [-]."""
HARD_KINDS = 4
"""Number of kinds of hard limits: v_ref, omega_ref, and their increments."""


@dataclass(frozen=True)
class Problem:
    """Definition of a controller's problem: configuration, discrete model, and user-defined terms.

    If `from_file` is False, the model was not identified on its robot, and the ratio of the wheels' yaw rate to that of
    the model has a larger initial uncertainty.

    Raises
    ------
    ValueError
        If the horizon is not longer than the dead time, so that no command takes effect within the horizon.
    """

    config: ControllerConfig
    model: DiscreteModel | NonlinearModel
    feed_forward: FeedForward
    terms: tuple[Term, ...] = ()
    from_file: bool = True
    prediction: Prediction | None = field(init=False)

    def __post_init__(self) -> None:
        """Check the horizon, and build the prediction matrices of a linear model."""
        model, horizon = self.model, self.config.horizon
        # A sample is part of the dead time if the previous command affects it more than the current command.
        dead_samples = model.dead_samples
        if isinstance(model, DiscreteModel):
            dead_samples = dead_samples + (np.abs(model.B1).sum(axis=0) > np.abs(model.B0).sum(axis=0))
        min_horizon = int(dead_samples.max()) + 1
        if horizon < min_horizon:
            raise ValueError(
                f"horizon = {horizon}: the horizon ends within the dead time of the model, {min_horizon - 1} steps of "
                f"{model.dt:g} s; set horizon to {min_horizon} or more"
            )
        prediction = build_prediction(model, horizon) if isinstance(model, DiscreteModel) else None
        object.__setattr__(self, "prediction", prediction)

    @cached_property
    def compiled_step(self) -> CompiledStep | None:
        """Compiled functions of a nonlinear model; None if the model is linear or has no compiled functions."""
        return self.model.compiled_step if isinstance(self.model, NonlinearModel) else None

    @property
    def history(self) -> int:
        """Number of past ticks that the estimator stores."""
        # The additional node is that of the current tick.
        return int(np.ceil(self.config.estimator.history / self.model.dt)) + 1

    @property
    def _max_extra_delay(self) -> int:
        """Maximum additional delay that the filter estimates [samples]; zero for a nonlinear model."""
        config = self.config
        # Without dead time compensation, past commands are not stored.
        is_estimated = config.compensation.delay and config.compensation.dead_time and self.prediction is not None
        return int(np.ceil(config.estimator.max_delay / self.model.dt)) if is_estimated else 0

    @property
    def _turn_rows(self) -> int:
        """Number of soft limits for the minimum turn radius: 2 (left and right), or 0 if it is not configured."""
        return 0 if self.config.limits.min_turn_radius is None else 2

    @property
    def _command_turn_rows(self) -> int:
        """Number of soft limits for the minimum commanded radius: 2 (left and right), or 0 if it is not configured."""
        return 0 if self.config.limits.min_commanded_radius is None else 2

    @property
    def _all_turn_rows(self) -> int:
        return self._turn_rows + self._command_turn_rows

    @property
    def soft_names(self) -> tuple[str, ...]:
        """Names of the kinds of soft limits, in the order of the core; `left` and `right` are wheels."""
        turns = [f"{name} {side}" for name in ("turn", "commanded turn") for side in ("left", "right")]
        kinds = turns[: self._turn_rows] + turns[2 : 2 + self._command_turn_rows]
        term_names = [f"{term.name}.{row}" for term in self.terms if term.soft for row in range(term.rows)]
        return (*BUILT_IN_SOFT, *kinds, *term_names)

    @property
    def curved(self) -> bool:
        """True if the configuration sets or estimates curved slip, which makes the twist non-affine."""
        s = self.config.estimator
        return any(s.start(name) or s.uncertainty(name) for name in CURVED_SLIPS)

    @property
    def sizes(self) -> dict[str, int]:
        """Fields of the C structure `ddmpc_sizes`."""
        model, terms = self.model, self.terms
        v, omega = (int(delay) for delay in model.delay)
        lag_v, lag_omega = (int(lag) for lag in self.feed_forward.whole)
        return {
            "steps": self.config.horizon,
            "states": model.order,
            "delay_v": v,
            "delay_omega": omega,
            # An additional delay is interpolated between two commands, so one command more than whole samples is
            # needed.
            "window": model.memory + (self._max_extra_delay + 1 if self._max_extra_delay else 0),
            "history": self.history,
            "lag_v": lag_v,
            "lag_omega": lag_omega,
            "residuals": sum(term.rows for term in terms if not term.soft),
            "soft": len(self.soft_names),
            "terms": len(terms),
            "parameters": sum(term.parameters for term in terms),
            "nonlinear": int(self.prediction is None),
            "turns": self._turn_rows,
            "slips": len(SLIPS if self.curved else FLAT_SLIPS),
            "model_parameters": len(self.compiled_step.parameters) if self.compiled_step else 0,
            "work": self.compiled_step.work if self.compiled_step else 0,
            "command_turns": self._command_turn_rows,
            "spare": self._max_extra_delay,
            # Several limits may be active at a sample, and each violated soft limit also needs an entry.
            "max_active": 6 * self.config.horizon + 32,
        }

    def constants(self) -> Constants:
        """Compute the fields of the C structure `ddmpc_constants`."""
        max_pause = self.history * self.model.dt
        times: Constants = {"sample_time": self.model.dt, "longest_pause": max_pause}
        parts = (times, self._velocity(), self._estimation(), self._prediction(), self._cost(), self._limits())
        merged: Constants = {}
        for part in (
            *parts,
            self._solution(),
            self._ladder(),
            self._fence(),
            self._monitor(),
            _core_constants("core_thresholds"),
        ):
            merged |= part
        return merged

    def _velocity(self) -> Constants:
        model = self.model
        if isinstance(model, NonlinearModel):
            n = model.order
            empty = {"A": (n, n), "B0": (n, 2), "B1": (n, 2), "C": (2, n), "mean_output": (2, n)}
            parameters = self.compiled_step.parameters if self.compiled_step else np.zeros(0)
            return {
                **{name: np.zeros(shape) for name, shape in empty.items()},
                "settled": model.settled,
                "model_parameters": parameters,
            }
        return {
            "A": model.A,
            "B0": model.B0,
            "B1": model.B1,
            "C": model.C,
            "mean_output": 0.5 * model.C @ (np.eye(model.order) + model.A),
            "settled": np.column_stack([model.settled_state(unit) for unit in np.eye(2)]),
            "model_parameters": np.zeros(0),
        }

    def _estimation(self) -> Constants:
        model, s, wheels, sensors = self.model, self.config.estimator, self.config.wheels, self.config.sensors
        enabled = self.config.compensation
        delays = [self._max_extra_delay > 0] * 2
        # Order of the filter's parameters: v_offset, omega_gain, longitudinal_gain, yaw_gain; six parameters of
        # side-slip; curved slip and gyro bias, which a zero uncertainty disables; delays.
        estimated = np.array(
            [*[enabled.v_offset, enabled.yaw_gain] * 2, *[enabled.side_slip] * 6, *[True] * 6, *delays]
        )
        kinds = (*PRIORS, "gyro_bias", "delay", "delay")
        uncertainty = estimated * np.array([s.uncertainty(kind) for kind in kinds])
        if not self.from_file:
            # The actual ratio of the tracks may differ from the ratio in `wheels`.
            uncertainty[kinds.index("omega_gain")] *= s.unknown_omega_gain_uncertainty / s.omega_gain_uncertainty
        drift = estimated * np.array([s.drift(kind) for kind in kinds])
        prior = configured_slip(self.config)
        # Bounds of gains are configured; bounds of curved slip follow from its initial uncertainty.
        margin = np.full(len(SLIPS), np.inf)
        margin[-len(CURVED_SLIPS) :] = _MAX_CURVED_DEVIATIONS * uncertainty[len(FLAT_SLIPS) : len(SLIPS)]
        min_slip, max_slip = np.array(astuple(prior)) - margin, np.array(astuple(prior)) + margin
        # Entries 1 to 3 are omega_gain, longitudinal_gain and yaw_gain.
        min_slip[1:4], max_slip[1:4] = s.min_gain, s.max_gain
        drive = model.drive
        inputs = np.array([s.v_input_noise, s.omega_input_noise])
        pose_drift = np.square([s.position_drift, s.position_drift, s.heading_drift])
        return {
            # Noise enters at the input and reaches the states through B0 + B1: Q_x of docs/how-it-works.md.
            "noise": (drive * inputs**2) @ drive.T,
            "pose_noise": pose_drift * model.dt,
            "prior": [*astuple(prior), 0.0, 0.0, 0.0],
            "evidence": np.square([s.slide_evidence, s.gain_evidence, s.delay_evidence, s.delay_evidence]),
            "doubt": np.square([s.gain_doubt, s.delay_doubt]),
            "uncertainty": uncertainty,
            # The variance of a random walk grows in proportion to time.
            "drift": model.dt * np.square(drift),
            # Ratio of yaw rates per omega_ref: ratio of tracks (wheels) over DC gain (model).
            "wheel_yaw_ratio": wheels.track / wheels.encoder_track / float(model.dc_gain[1, 1]),
            "surprise": s.surprise,
            "patience": round(s.lasting_surprise / model.dt),
            "min_yaw_rate": s.min_yaw_rate,
            "min_speed": s.min_speed,
            "min_slip": min_slip,
            "max_slip": max_slip,
            "stamp_history": s.history,
            "pose_variance": np.square([s.position_noise, s.position_noise, s.heading_noise]),
            "twist_variance": np.square([s.wheel_speed_noise, s.wheel_yaw_rate_noise, s.yaw_rate_noise]),
            "sensor_delay": [sensors.wheels.total_delay, sensors.yaw_rate.total_delay, sensors.pose.delay],
            "sensor_scale": np.array([sensors.wheels.sign, sensors.wheels.turn_sign, sensors.yaw_rate.sign])
            * [sensors.wheels.scale, sensors.wheels.scale, sensors.yaw_rate.scale],
            "sensor_heading": sensors.pose.heading,
            "largest_twist": [s.max_wheel_speed, s.max_yaw_rate, s.max_yaw_rate],
            "largest_twist_jump": [s.max_wheel_speed_jump, s.max_yaw_rate_jump, s.max_yaw_rate_jump],
            "largest_position_jump": s.max_position_jump,
            "largest_heading_jump": s.max_heading_jump,
        }

    def _monitor(self) -> Constants:
        monitor, test = self.config.monitor, dict(_core_constants("sensor_test"))
        base_rate, scale = test.pop("alarms")
        return {
            "monitor": monitor.enabled,
            # Evidence at which the rate of false alarms, rate * exp(-evidence / scale), is the configured rate.
            "enough": scale * float(np.log(base_rate / monitor.false_alarm_rate)),
            **test,
            "monitor_turn_ratio": monitor.turn_ratio,
            "monitor_trust": monitor.trust_after,
            "wheel_limits": monitor.wheel_limits,
        }

    def _prediction(self) -> Constants:
        N, prediction, n, W = self.config.horizon, self.prediction, self.model.order, self.sizes["window"]
        width = round_up(2 * N)
        if prediction is None:
            empty = {
                "from_state": (N + 1, 2, n),
                "from_past": (N + 1, 2, W, 2),
                "response": (2, 2, N + 1),
                "twist_row": (2, 2 * width),
                "mean_row": (2, 2 * width),
                "heading_row": (2 * width,),
                "heading_hessian": (2 * N, 2 * N),
            }
            return {name: np.zeros(shape) for name, shape in empty.items()}
        weighted_heading = self._pose_weights()[:, 2:] * prediction.heading_from_plan[1:]
        return {
            "from_state": prediction.from_state.reshape(N + 1, 2, -1),
            # Commands that are older than the memory of the model have no effect, so their columns are zero.
            "from_past": np.pad(
                prediction.from_past.reshape(N + 1, 2, -1, 2), ((0, 0), (0, 0), (W - self.model.memory, 0), (0, 0))
            ),
            "response": prediction.from_plan[:, :2].reshape(N + 1, 2, 2).transpose(1, 2, 0),
            "twist_row": [_toeplitz_row(prediction.from_plan[channel::2]) for channel in (0, 1)],
            "mean_row": [_toeplitz_row(prediction.mean_from_plan[channel::2]) for channel in (0, 1)],
            "heading_row": _toeplitz_row(prediction.heading_from_plan),
            # Hessian for a yaw gain of 1; the core multiplies it by the squared gain at each tick.
            "heading_hessian": prediction.heading_from_plan[1:].T @ weighted_heading,
        }

    def _pose_weights(self) -> FloatArray:
        """Return weights (N, 3) of the along-track, cross-track and heading errors at the samples 1 to N."""
        w = self.config.weights
        table = np.tile([w.along, w.across, w.heading], (self.config.horizon, 1))
        table[-1] *= w.terminal
        return table

    def _cost(self) -> Constants:
        w, pose_weights = self.config.weights, self._pose_weights()
        return {
            # The roots scale the rows of the stacked residuals; the Hessian of the heading is computed separately.
            "along": np.sqrt(pose_weights[:, 0]),
            "across": np.sqrt(pose_weights[:, 1]),
            "heading": pose_weights[:, 2],
            "command_weight": [w.v, w.omega],
            "increment_weight": [w.v_increment, w.omega_increment],
            # The matrix is stored in column-major order.
            "inverse_gain": self.feed_forward.inverse_gain.T.reshape(-1),
            "lag_rest": self.feed_forward.fraction,
            "price": w.soft,
            "price_slope": w.soft_quadratic,
        }

    def _limits(self) -> Constants:
        limits, dt = self.config.limits, self.model.dt
        built_in = [limits.predicted_v, limits.predicted_omega, limits.wheel_speed, limits.wheel_speed, limits.corridor]
        built_in += [0.0] * self._all_turn_rows  # placeholders: limits.c computes these bounds from the radius
        soft = [term for term in self.terms if term.soft]
        return {
            "largest_command": [*limits.v.sides, *limits.omega.sides],
            "slew": np.array([*limits.v_slew.sides, *limits.omega_slew.sides]) * dt,
            "braking": np.array([limits.v_braking, limits.omega_braking]) * dt,
            "soft_upper": np.concatenate([built_in, *(term.bounds[1] for term in soft)]),
            "soft_lower": np.concatenate([np.negative(built_in), *(term.bounds[0] for term in soft)]),
            "half_track": 0.5 * self.config.wheels.track,
            "min_turn_radius": limits.min_turn_radius or 0.0,
            "min_commanded_radius": limits.min_commanded_radius or 0.0,
        }

    def _solution(self) -> Constants:
        solver = self.config.solver
        return {
            "slack": SLACK * solver.tolerance,
            "active_set": solver.active_set_iterations,
            "forced": solver.method != "auto",
            "max_missed": solver.max_missed,
        }

    def _ladder(self) -> Constants:
        failure, finish, reentry = self.config.failure, self.config.finish, self.config.reentry
        return {
            "max_pose_age": failure.max_pose_age,
            "dead_reckoning": failure.dead_reckoning,
            "max_position_error": failure.max_position_error,
            "max_reused_ticks": failure.max_reused_ticks,
            "resume": failure.resume,
            "resume_within": failure.resume_within,
            "finish_position": finish.position,
            "finish_speed": finish.speed,
            "finish_timeout": finish.timeout,
            "reentry": reentry.enabled,
            "band": reentry.band,
            "heading_band": reentry.heading_band,
            "wait": reentry.wait,
            "heading_wait": reentry.heading_wait,
            "behind": BEHIND * reentry.wait,
            "ahead": AHEAD * reentry.wait,
            "standing": STANDING,
            "turning": TURNING,
        }

    def _fence(self) -> Constants:
        fence = self.config.fence
        return {
            "fence": fence.enabled,
            "fence_at_start": fence.frame == "start",
            "fence_middle": [fence.x, fence.y, fence.heading],
            "fence_reach": [0.5 * fence.length - fence.margin, 0.5 * fence.width - fence.margin],
        }


@cache
def _core_constants(name: str) -> dict[str, Any]:
    """Read robot-independent constants of the core from `mpc/config/<name>.yaml`, by the name of the field in C."""
    data: dict[str, Any] = read_yaml(Path(__file__).parents[1] / "config" / f"{name}.yaml")
    return data


def configured_slip(config: ControllerConfig) -> Slip:
    """Return the initial slip of the estimate from the configuration."""
    s = config.estimator
    flat = Slip(side_slip=s.side_slip, load_shift=s.load_shift) if config.compensation.side_slip else Slip()
    return replace(flat, **{name: s.start(name) for name in CURVED_SLIPS})


def round_up(count: int) -> int:
    """Round `count` up to a multiple of `PADDING`."""
    return -(-count // PADDING) * PADDING


def _toeplitz_row(matrix: FloatArray) -> FloatArray:
    """Return the padded last row of a Toeplitz matrix; all other rows are shifted sections of this row."""
    row = matrix[-1]
    return np.concatenate([row, np.zeros(2 * round_up(row.size) - row.size)])


@dataclass(frozen=True)
class Prediction:
    """Prediction matrices from state, past commands and future commands to predicted twists.

    Commands are flattened step by step: (v_ref[0], omega_ref[0], v_ref[1], ...). Rows for samples are ordered v[0],
    omega[0], v[1], ...; rows for mean twists over arcs have the same order.

    Attributes
    ----------
    horizon
        Number of steps N.
    from_state, from_past, from_plan
        (2 (N + 1), n), (2 (N + 1), 2 memory), (2 (N + 1), 2 N) maps to the twist at the samples 0 to N.
    mean_from_plan
        (2 N, 2 N) map from the plan to the mean twist over each of the N arcs.
    heading_from_plan
        (N + 1, 2 N) map from the plan to the heading at the samples 0 to N, relative to that at sample 0.
    """

    horizon: int
    from_state: FloatArray
    from_past: FloatArray
    from_plan: FloatArray
    mean_from_plan: FloatArray
    heading_from_plan: FloatArray


def build_prediction(model: DiscreteModel, horizon: int) -> Prediction:
    """Build the prediction matrices of the model over `horizon` steps.

    Raises
    ------
    ValueError
        If `horizon` is less than 1.
    """
    if horizon < 1:
        raise ValueError(f"horizon = {horizon}: set it to at least 1")
    memory, n = model.memory, model.order
    width = 2 * (memory + horizon)
    # State at each sample as a linear function of [x0, past commands, plan].
    state = np.hstack([np.eye(n), np.zeros((n, width))])
    twists = [model.C @ state]
    for k in range(horizon):
        state = model.A @ state
        for channel in (0, 1):
            newer = n + 2 * (memory + k - int(model.delay[channel])) + channel
            state[:, newer] += model.B0[:, channel]
            # The previous command still acts during the fractional part of the dead time.
            state[:, newer - 2] += model.B1[:, channel]
        twists.append(model.C @ state)
    stacked_twists = np.vstack(twists)
    from_plan = stacked_twists[:, n + 2 * memory :]
    mean = 0.5 * (from_plan[:-2] + from_plan[2:])
    heading = np.vstack([np.zeros(2 * horizon), np.cumsum(model.dt * mean[1::2], axis=0)])
    return Prediction(horizon, stacked_twists[:, :n], stacked_twists[:, n : n + 2 * memory], from_plan, mean, heading)
