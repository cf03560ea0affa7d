"""Limits of the base on the inputs: maximum command of each side, and maximum rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS, BaseEffects, TwistRange, TwistSlew, apply_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem, steady_start
from diffdrive_mpc.models.two_sided import SlewLimit, VelocityLimit, YawRateLimit, sides_of
from diffdrive_mpc.models.velocity_model import CHANNELS

# Relative difference below which both sides are averaged to one value.
_SAME_SIDES = 0.02
# Step of a derivative relative to the limit; the limited inputs are piecewise linear in most limits.
_RELATIVE_STEP = 1e-6


def side_name(channel: str, kind: int) -> str:
    """Return the name of the limit with index `kind` of a channel, such as `forward`, `left` or `brake`."""
    return ((YawRateLimit if channel == "omega" else VelocityLimit).names + SlewLimit.names)[kind]


def limit_names(is_limited: Sequence[Sequence[bool]]) -> list[str]:
    """Return the names of the limits that are True in `is_limited` (2, 4), such as "v.forward"."""
    pairs = zip(CHANNELS, is_limited, strict=True)
    return [f"{channel}.{side_name(channel, int(kind))}" for channel, row in pairs for kind in np.flatnonzero(row)]


def effects_of(limit: FloatArray) -> dict[str, dict[str, Any]]:
    """Convert limits (2, 4) of v and omega to `base_effects` of a model file; similar sides are averaged."""
    groups: dict[str, dict[str, Any]] = {}
    for row, kinds in zip(limit, ((VelocityLimit, SlewLimit), (YawRateLimit, SlewLimit)), strict=True):
        channel = "v" if kinds[0] is VelocityLimit else "omega"
        for name, kind, sides in zip(("twist_range", "twist_slew"), kinds, row.reshape(2, 2), strict=True):
            if sides.min() < np.inf:
                is_symmetric = np.ptp(sides) < _SAME_SIDES * sides.min()
                groups.setdefault(name, {})[channel] = kind(*([sides.mean()] * 2 if is_symmetric else sides)).plain
    return groups


def limits_in(effects: BaseEffects) -> FloatArray:
    """Return the limits (2, 4) of v and omega of a base for `LinearSystem`. This is the inverse of `effects_of`."""
    groups = effects.twist_range or TwistRange(), effects.twist_slew or TwistSlew()
    rows = [[getattr(group, channel) for group in groups] for channel in CHANNELS]
    return np.array([np.concatenate([sides_of(np.inf if limit is None else limit) for limit in row]) for row in rows])


def limit_derivatives(inputs: FloatArray, limit: FloatArray, dt: float, start: FloatArray) -> FloatArray:
    """Return the derivatives (4, K, m) of `apply_limits` with respect to each kind of limit; zero if infinite."""
    values, derivatives = apply_limits(inputs, limit, dt, start), np.zeros((len(KINDS), *inputs.shape))
    for kind in np.flatnonzero(np.isfinite(limit).any(axis=0)):
        # An infinite limit needs a finite step, because a relative step would be infinite and its derivative NaN.
        step = np.where(np.isfinite(limit[:, kind]), _RELATIVE_STEP * limit[:, kind], 1.0)
        stepped = limit.copy()
        stepped[:, kind] += step
        derivatives[kind] = (apply_limits(inputs, stepped, dt, start) - values) / step
    return derivatives


def limited_inputs(
    system: LinearSystem, experiment: SampledExperiment, function: Callable[..., FloatArray] = apply_limits
) -> FloatArray:
    """Return the inputs (K, m) limited by the base, or their derivatives if `function` is `limit_derivatives`."""
    start = steady_start(system, experiment.first_readings)[1]
    return function(experiment.inputs, system.limit, experiment.dt, start)
