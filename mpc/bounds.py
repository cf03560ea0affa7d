"""Hard bounds of the command: range and slew, against the last command sent."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Limits


def slew_step(limits: Limits, dt: float) -> FloatArray:
    """(2,) largest change of the command from one tick to the next [m/s, rad/s]."""
    return np.array([limits.v_slew, limits.omega_slew]) * dt


def command_box(limits: Limits, dt: float, last_command: FloatArray, steps: int, share: float = 1.0) -> FloatArray:
    """Bounds on |command| for the next steps.

    A limit that was tightened below the last command is reached at the slew limit: until then the bound is what the
    slew limit can reach, so the problem always has a solution.

    Returns
    -------
    FloatArray
        (steps, 2) [m/s, rad/s].
    """
    reachable = np.abs(last_command) - slew_step(limits, dt) * np.arange(1, steps + 1)[:, None]
    return np.asarray(np.maximum(reachable, [share * limits.v, share * limits.omega]))


def clip_command(
    command: FloatArray,
    limits: Limits,
    dt: float,
    last_command: FloatArray,
    share: float = 1.0,
    *,
    braking: bool = False,
) -> FloatArray:
    """The nearest command (2,) inside `share` of range, and slew: a solver meets its bounds only to its tolerance.

    With `braking` the rates of braking take the place of slew. Number by number: for two of them arrays take ten times
    as long.
    """
    v, omega = command
    last_v, last_omega = last_command.tolist()
    v_rate, omega_rate = (limits.v_braking, limits.omega_braking) if braking else (limits.v_slew, limits.omega_slew)
    return np.array(
        [
            _clip(float(v), last_v, share * limits.v, v_rate * dt),
            _clip(float(omega), last_omega, share * limits.omega, omega_rate * dt),
        ]
    )


def inside_limits(command: FloatArray, limits: Limits, last_command: FloatArray) -> FloatArray:
    """The nearest command (2,) to `command` inside the limits, or inside `last_command` where that is outside them."""
    v, omega = command.tolist()
    last_v, last_omega = last_command.tolist()
    top_v, top_omega = max(limits.v, abs(last_v)), max(limits.omega, abs(last_omega))
    return np.array([min(max(v, -top_v), top_v), min(max(omega, -top_omega), top_omega)])


def _clip(wanted: float, last: float, largest: float, step: float) -> float:
    box = max(abs(last) - step, largest)
    lower, upper = max(last - step, -box), min(last + step, box)
    return min(max(wanted, lower), upper)
