"""What the C sources in `mpc/native` need to know of a controller: sizes, and constants in the order of their structs.

The values go straight into memory for use from Python, or as text into an exported library.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Estimator
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.kalman import SlipFilter
from diffdrive_mpc.mpc.problem import TrackingProblem

# DDMPC_LANES
_LANES = 8

Constants = dict[str, FloatArray]
"""Fields of a struct, in its order."""


def estimator_sizes(model: DiscreteModel, history: int) -> dict[str, int]:
    """Macros of `estimator.h` for a history of so many ticks."""
    return {**_model_sizes(model), "DDMPC_HISTORY": history}


def tracking_sizes(model: DiscreteModel, steps: int, feed_forward: FeedForward) -> dict[str, int]:
    """Macros of `condense.h` for a horizon of `steps`."""
    v, omega = feed_forward.whole.tolist()
    return {**_model_sizes(model), "DDMPC_STEPS": steps, "DDMPC_LAG_V": v, "DDMPC_LAG_OMEGA": omega}


def _model_sizes(model: DiscreteModel) -> dict[str, int]:
    v, omega = model.delay.tolist()
    return {"DDMPC_STATES": model.order, "DDMPC_DELAY_V": v, "DDMPC_DELAY_OMEGA": omega}


def estimation_constants(model: DiscreteModel, settings: Estimator, slip_filter: SlipFilter) -> Constants:
    """Fields of `ddmpc_estimation`."""
    s, f = settings, slip_filter
    return _arrays(
        dt=model.dt,
        A=model.A,
        B0=model.B0,
        B1=model.B1,
        C=model.C,
        mean_output=f.mean_output,
        settled=f.settled,
        noise=f.noise[: model.order, : model.order],
        pose_noise=np.diag(f.noise)[-3:],
        drift=f.drift,
        uncertainty=f.uncertainty,
        wheel_yaw_ratio=f.wheel_yaw_ratio,
        surprise=s.surprise,
        patience=f.patience,
        least_yaw_rate=s.least_yaw_rate,
        least_speed=s.least_speed,
        least_gain=s.least_gain,
        most_gain=s.most_gain,
        history=s.history,
        pose_variance=np.square([s.position_noise, s.position_noise, s.heading_noise]),
        twist_variance=np.square([s.wheel_speed_noise, s.wheel_yaw_rate_noise, s.yaw_rate_noise]),
        largest_twist=[s.max_wheel_speed, s.max_yaw_rate, s.max_yaw_rate],
        largest_twist_jump=[s.max_wheel_speed_jump, s.max_yaw_rate_jump, s.max_yaw_rate_jump],
        largest_position_jump=s.max_position_jump,
        largest_heading_jump=s.max_heading_jump,
    )


def tracking_constants(problem: TrackingProblem, feed_forward: FeedForward) -> Constants:
    """Fields of `ddmpc_tracking`."""
    N, model, prediction = problem.steps, problem.model, problem.prediction
    weights, limits = problem.config.weights, problem.config.limits
    pose_weights = problem.pose_weights()
    weighted_heading = pose_weights[:, 2:] * prediction.heading_from_plan[1:]
    return _arrays(
        dt=model.dt,
        from_state=prediction.from_state.reshape(N + 1, 2, -1),
        from_past=prediction.from_past.reshape(N + 1, 2, -1, 2),
        response=prediction.from_plan[:, :2].reshape(N + 1, 2, 2).transpose(1, 2, 0),
        mean_row=[_longest_row(prediction.mean_from_plan[channel::2]) for channel in (0, 1)],
        heading_row=_longest_row(prediction.heading_from_plan),
        heading_hessian=prediction.heading_from_plan[1:].T @ weighted_heading,
        along=np.sqrt(pose_weights[:, 0]),
        across=np.sqrt(pose_weights[:, 1]),
        heading=pose_weights[:, 2],
        command_weight=[weights.v, weights.omega],
        increment_weight=[weights.v_increment, weights.omega_increment],
        lean_along=weights.along,
        lean_heading=weights.heading,
        largest_command=[limits.v, limits.omega],
        slew=np.array([limits.v_slew, limits.omega_slew]) * model.dt,
        soft_limit=problem.largest_soft(),
        half_track=0.5 * problem.config.wheels.track,
        inverse_gain=feed_forward.inverse_gain,
        lag_rest=feed_forward.rest,
    )


def vector(constants: Constants) -> FloatArray:
    """All fields one after the other, as they lie in memory."""
    return np.concatenate([values.ravel() for values in constants.values()])


def sizes_header(sizes: Mapping[str, int]) -> str:
    """Text of ddmpc_sizes.h."""
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    return "\n".join(["#ifndef DDMPC_SIZES_H", "#define DDMPC_SIZES_H", *lines, "#endif", ""])


def initialiser(constants: Constants) -> str:
    """Text of a C initialiser of the struct, in single or double precision as `R` says."""
    fields = [f"    .{name} = {_braced(values)}" for name, values in constants.items()]
    return "{\n" + ",\n".join(fields) + "\n}"


def _braced(values: FloatArray) -> str:
    if values.ndim == 0:
        return f"R({float(values)!r})"
    return "{" + ", ".join(_braced(part) for part in values) + "}"


def _arrays(**fields: object) -> Constants:
    return {name: np.array(values, dtype=float) for name, values in fields.items()}


def _longest_row(matrix: FloatArray) -> FloatArray:
    """The last row of a Toeplitz matrix, padded: any other row begins further along it."""
    row = matrix[-1]
    return np.concatenate([row, np.zeros(2 * (-(-row.size // _LANES) * _LANES) - row.size)])
