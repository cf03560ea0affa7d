"""Limits of the base on the way in: the largest command on each side, and the largest rates that it follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS, BaseEffects, TwistRange, TwistSlew, limited
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem, settled_start
from diffdrive_mpc.models.two_sided import SlewLimit, VelocityLimit, YawRateLimit, sides_of
from diffdrive_mpc.models.velocity_model import CHANNELS

# Sides that differ by less than this part are one number in a file.
_ALIKE = 0.02
# Step of a derivative, relative to the limit: what follows is piecewise linear in most of them.
_STEP = 1e-6


def side_name(channel: str, kind: int) -> str:
    """Return the name of a limit of a channel, by the number of its kind: `forward`, `left`, `brake`."""
    return ((YawRateLimit if channel == "omega" else VelocityLimit).names + SlewLimit.names)[kind]


def limit_names(limited: Sequence[Sequence[bool]]) -> list[str]:
    """Return the names of those limits of v and omega that are marked (2, 4), each with its channel."""
    pairs = zip(CHANNELS, limited, strict=True)
    return [f"{channel}.{side_name(channel, int(kind))}" for channel, row in pairs for kind in np.flatnonzero(row)]


def effects_of(limit: FloatArray) -> dict[str, dict[str, Any]]:
    """Return limits (2, 4) of v and omega as `base_effects` of a model file; sides that differ little are equal."""
    groups: dict[str, dict[str, Any]] = {}
    for row, kinds in zip(limit, ((VelocityLimit, SlewLimit), (YawRateLimit, SlewLimit)), strict=True):
        channel = "v" if kinds[0] is VelocityLimit else "omega"
        for name, kind, sides in zip(("twist_range", "twist_slew"), kinds, row.reshape(2, 2), strict=True):
            if sides.min() < np.inf:
                alike = np.ptp(sides) < _ALIKE * sides.min()
                groups.setdefault(name, {})[channel] = kind(*([sides.mean()] * 2 if alike else sides)).plain
    return groups


def limits_in(effects: BaseEffects) -> FloatArray:
    """Return the limits (2, 4) of v and omega, as `LinearSystem` has them, of a base; the inverse of `effects_of`."""
    groups = effects.twist_range or TwistRange(), effects.twist_slew or TwistSlew()
    rows = [[getattr(group, channel) for group in groups] for channel in CHANNELS]
    return np.array([np.concatenate([sides_of(np.inf if limit is None else limit) for limit in row]) for row in rows])


def slopes(inputs: FloatArray, limit: FloatArray, dt: float, start: FloatArray) -> FloatArray:
    """Return the derivatives (4, K, m) of `limited` by each kind of limit; zero where it is infinite."""
    taken, derivatives = limited(inputs, limit, dt, start), np.zeros((len(KINDS), *inputs.shape))
    for kind in np.flatnonzero(np.isfinite(limit).any(axis=0)):
        step = np.where(np.isfinite(limit[:, kind]), _STEP * limit[:, kind], 1.0)
        moved = limit.copy()
        moved[:, kind] += step
        derivatives[kind] = (limited(inputs, moved, dt, start) - taken) / step
    return derivatives


def taken(system: LinearSystem, experiment: SampledExperiment, by: Callable[..., FloatArray] = limited) -> FloatArray:
    """Return the inputs (K, m) that the base of a system carries out, or its `slopes`."""
    start = settled_start(system, experiment.first_readings)[1]
    return by(experiment.inputs, system.limit, experiment.dt, start)
