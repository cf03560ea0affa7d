"""Derivation of the weights on command increments from the delay that the closed loop must tolerate.

Without active limits the controller is a linear feedback of the estimate, u_0 = K z. Along a straight path at constant
speed the closed loop is linear, and it is stable if all eigenvalues lie inside the unit circle. An unmodelled delay
moves the eigenvalues outwards; larger weights on the increments move them inwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Margin
from diffdrive_mpc.mpc.problem.constants import build_prediction

SPEED = 0.5
"""Speed on the straight path [m/s], equal to that of the built-in trajectories."""
MIN_WEIGHTS, MAX_WEIGHT = np.array([5.0, 4.0]), 1e4
"""Bounds of the weights [s^2/m^2, s^2/rad^2].

The minimum weights (2,) of v and omega were tuned for SM on the mujoco plant, over 13 robots and conditions, seeds 101
and 103. With smaller weights, commands oscillate."""
# 14 bisections of ln(1e4 / 4) leave a factor of 1.0005, below the three digits of `with_increments`.
_BISECTIONS = 14
_STABLE = 1.0 + 1e-6
"""Limit of the spectral radius; it exceeds 1 because an error with zero weight has the eigenvalue 1."""


def feedback(model: DiscreteModel, config: ControllerConfig) -> Callable[[FloatArray], FloatArray]:
    """Return a function that maps the weights (2,) of the increments to the gain K (2, n + 2 m + 3) of u_0 = K z.

    The vector z contains the states of the model, the m pending commands (oldest first), and the along-track [m],
    cross-track [m] and heading [rad] errors at the speed `SPEED`.
    """
    # Without limits the cost is U'HU / 2 + U'Gz, with the minimiser U = -H^-1 G z. Its first command is the feedback.
    N, n, m, dt, w = config.horizon, model.order, model.memory, model.dt, config.weights
    prediction = build_prediction(model, N)
    twist = np.hstack([prediction.from_state, prediction.from_past, np.zeros((2 * N + 2, 3))])
    mean, units = 0.5 * (twist[:-2] + twist[2:]), np.eye(n + 2 * m + 3)
    plan_maps = prediction.mean_from_plan, prediction.heading_from_plan
    heading = units[-1] + np.vstack([np.zeros(len(units)), dt * np.cumsum(mean[1::2], axis=0)])
    # Near a straight path, the lateral speed is the product of heading and speed, integrated by the trapezoidal rule.
    across = units[-2] + 0.5 * dt * SPEED * np.cumsum(heading[:-1] + heading[1:], axis=0)
    along = units[-3] + dt * np.cumsum(mean[::2], axis=0)
    by_plan = (
        dt * np.cumsum(plan_maps[0][::2], axis=0),
        0.5 * dt * SPEED * np.cumsum(plan_maps[1][:-1] + plan_maps[1][1:], axis=0),
        plan_maps[1][1:],
    )
    factor = np.append(np.ones(N - 1), w.terminal)[:, None]
    weighted = [
        *zip(
            (w.along * factor, w.across * factor, w.heading * factor),
            (along, across, heading[1:]),
            by_plan,
            strict=True,
        ),
        (np.tile([w.v, w.omega], N)[:, None], np.zeros((2 * N, len(units))), np.eye(2 * N)),
    ]
    H = sum(rows.T @ (weight * rows) for weight, _, rows in weighted)
    G = sum(rows.T @ (weight * fixed) for weight, fixed, rows in weighted)
    last_command, difference = units[n + 2 * m - 2 : n + 2 * m], np.eye(N) - np.eye(N, k=-1)

    def gain(increments: FloatArray) -> FloatArray:
        # The first increment is relative to the newest pending command.
        rhs = G - np.vstack([increments[:, None] * last_command, np.zeros((2 * N - 2, len(units)))])
        return np.asarray(-np.linalg.solve(H + np.kron(difference.T @ difference, np.diag(increments)), rhs)[:2])

    return gain


def spectral_radius(model: DiscreteModel, K: FloatArray, extra_delay: FloatArray) -> float:
    """Return the spectral radius of the loop with feedback `K` and an unmodelled delay `extra_delay` (2,) [samples]."""
    n, m, dt = model.order, model.memory, model.dt
    # The state of the loop contains the states of the model, the commands (oldest first), and the errors. It has more
    # commands than the state of the controller, which does not model the extra delay.
    n_commands = m + int(np.ceil(extra_delay.max())) + 1
    size = n + 2 * n_commands + 3
    selection = np.zeros((K.shape[1], size))
    selection[:n, :n], selection[-3:, -3:] = np.eye(n), np.eye(3)
    selection[n : n + 2 * m, n + 2 * (n_commands - m) : n + 2 * n_commands] = np.eye(2 * m)
    commands = np.vstack([np.eye(2 * n_commands, size, k=n), K @ selection]).reshape(n_commands + 1, 2, size)
    whole = np.floor(extra_delay).astype(int)
    loop = np.zeros((size, size))
    loop[:n, :n] = model.A
    for channel in (0, 1):
        newest, part = n_commands - int(model.delay[channel]) - whole[channel], extra_delay[channel] - whole[channel]
        active = [(1 - part) * commands[newest - i, channel] + part * commands[newest - i - 1, channel] for i in (0, 1)]
        loop[:n] += np.outer(model.B0[:, channel], active[0]) + np.outer(model.B1[:, channel], active[1])
    # The commands are shifted by one sample, and the new command K z is appended.
    loop[n:-3] = commands[1:].reshape(-1, size)
    units = np.eye(size)
    # Mean twist over the sample, as in the prediction.
    v, omega = 0.5 * (model.C @ units[:n] + model.C @ loop[:n])
    loop[-3], loop[-1] = units[-3] + dt * v, units[-1] + dt * omega
    loop[-2] = units[-2] + 0.5 * dt * SPEED * (units[-1] + loop[-1])
    return float(np.abs(np.linalg.eigvals(loop)).max())


def increment_weights(model: DiscreteModel, config: ControllerConfig) -> FloatArray:
    """Return the minimum weights (2,) of the increments of v and omega with which the loop tolerates the margin.

    The margins of v and omega are applied one at a time. A weight is NaN if no weight up to `MAX_WEIGHT` suffices.
    """
    gain, weights, min_weights = feedback(model, config), MIN_WEIGHTS.copy(), np.full(2, np.nan)
    for channel, margin in enumerate((config.margin.v, config.margin.omega)):
        extra_delay = np.eye(2)[channel] * margin / model.dt
        low, high = np.log([MIN_WEIGHTS[channel], MAX_WEIGHT])
        for _ in range(_BISECTIONS):
            weights[channel] = np.exp(0.5 * (low + high))
            try:
                is_stable = spectral_radius(model, gain(weights), extra_delay) < _STABLE
            except np.linalg.LinAlgError:  # extreme weights make the matrix numerically singular
                is_stable = False
            if is_stable:
                min_weights[channel], high = weights[channel], np.log(weights[channel])
            else:
                low = np.log(weights[channel])
    return min_weights


@dataclass(frozen=True)
class _Loop:
    """Model and settings that determine the weights; `numbers` contains their values as bytes, as a cache key."""

    numbers: bytes
    model: DiscreteModel = field(compare=False)
    config: ControllerConfig = field(compare=False)

    @classmethod
    def from_settings(cls, model: DiscreteModel, config: ControllerConfig) -> _Loop:
        w, margin = config.weights, config.margin
        sizes = [w.along, w.across, w.heading, w.v, w.omega, w.terminal, margin.v, margin.omega]
        parts = (model.A, model.B0, model.B1, model.C, model.delay, [model.dt, config.horizon], sizes)
        return cls(np.concatenate([np.ravel(part) for part in parts]).tobytes(), model, config)


@lru_cache(maxsize=64)
def _increment_weights(loop: _Loop) -> tuple[float, ...]:
    return tuple(increment_weights(loop.model, loop.config).tolist())


def with_increments(config: ControllerConfig, model: DiscreteModel | NonlinearModel) -> ControllerConfig:
    """Return `config` with unset weights on increments derived from the margin.

    The weights are `MIN_WEIGHTS` for a nonlinear model, and if no weight results in the default margin, for instance
    with a short horizon.

    Raises
    ------
    ConfigError
        If the margin is not the default and no weight results in this margin.
    """
    unset = [name for name in ("v", "omega") if getattr(config.weights, f"{name}_increment") is None]
    if not unset:
        return config
    derived = dict.fromkeys(unset, np.nan)
    if isinstance(model, DiscreteModel):
        derived |= zip(("v", "omega"), _increment_weights(_Loop.from_settings(model, config)), strict=True)
    weights = {}
    for name in unset:
        margin, key = getattr(config.margin, name), f"{name}_increment"
        is_derived = np.isfinite(derived[name])
        if not is_derived and margin != getattr(Margin(), name) and isinstance(model, DiscreteModel):
            raise ConfigError(
                f"margin.{name} = {margin:g} s: no weight on the increments of {name} results in this margin with the "
                f"other weights and horizon = {config.horizon}; set a smaller margin, or weights.{key}"
            )
        weights[key] = float(f"{derived[name]:.3g}") if is_derived else float(MIN_WEIGHTS[int(name == "omega")])
    return config.model_copy(update={"weights": config.weights.model_copy(update=weights)})
