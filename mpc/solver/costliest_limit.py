"""Search for the active limit that increases the cost of a plan most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.two_sided import TwoSided
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS as HARD
from diffdrive_mpc.mpc.solver.backend import Program

_KEYS = {"v": "predicted_v", "omega": "predicted_omega", "right": "wheel_speed", "left": "wheel_speed"}
_KEYS |= {"across": "corridor", "turn": "min_turn_radius", "commanded": "min_commanded_radius"}


def costliest_limit(program: Program, config: ControllerConfig, soft_names: Sequence[str]) -> str:
    """Return the key of the limit whose relative relaxation reduces the cost most; empty if no limit is active.

    `soft_names` (kinds - 4,) are the names of the soft limits. For soft limits of terms, the result is such a name.
    """
    multipliers, bounds = program.multipliers, np.where(program.multipliers > 0.0, program.upper, program.lower)
    # User-defined terms may have infinite values, for which the product below is undefined.
    with np.errstate(invalid="ignore"):
        # A relative relaxation refers to the limits, whereas soft bounds are relative to the values at a zero plan.
        bounds[HARD:] = program.soft_limits[:, None]
        # A multiplier is the change of the cost per unit of its bound.
        costs = np.nan_to_num(np.where(multipliers != 0.0, np.abs(multipliers * bounds), 0.0))
    kind, step = divmod(int(np.argmax(costs)), costs.shape[1])
    if costs[kind, step] == 0.0:
        return ""
    if kind >= HARD:
        name = soft_names[kind - HARD]
        return f"limits.{_KEYS[name.split()[0]]}" if name.split()[0] in _KEYS else name
    name, sense = ("v", "omega", "v_slew", "omega_slew")[kind], multipliers[kind, step]
    # The side of a slew limit (accelerate or brake) depends on the sign of the increment and of the previous command.
    if kind > 1:
        previous = program.guess[2 * (step - 1) + kind % 2] if step else program.last_command[kind % 2]
        sense *= -1.0 if previous < 0.0 else 1.0
    limit = getattr(config.limits, name)
    has_sides = isinstance(limit, TwoSided) and not limit.is_symmetric
    return f"limits.{name}.{limit.names[bool(sense < 0.0)]}" if has_sides else f"limits.{name}"
