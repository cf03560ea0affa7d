"""Recovery metrics of a run after a disturbance: return to the path, and control effort.

Errors are those of the true pose, without measurement noise. An excursion is a lateral error outside the band (Guffanti
et al. 2026, PMC12845739); normal tracking errors of a few millimetres are within the band.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Recovery:
    """Recovery metrics of a run; the names are those in `bench.json` and include units.

    Attributes
    ----------
    recovery_time_s
        Time from the end of the disturbance to the first tick from which |lateral| stays within the band until the end
        of the reference. The value is 0 if the robot does not leave the band after the disturbance, infinity if the
        robot is outside the band at the end of the reference or the run ends early, and NaN if all disturbances last
        until the end of the run or the lateral error is not finite.
    overshoot_m
        Maximum distance from the path on the side opposite to the excursion, after excursion and disturbance. The
        excursion is the last tick outside the band during the disturbance or, if there is none, the first tick outside
        the band after the disturbance; for a disturbance without end, it is the first tick outside the band after the
        start. The value is 0 if there is no excursion or the robot does not cross the path, and NaN if there is no
        disturbance or the lateral error is not finite. Normal tracking errors on the opposite side are included.
    lateral_max_m
        Maximum |lateral| of the run.
    command_energy_v, command_energy_omega
        Integral of the squared command over the counted ticks [m^2/s], [rad^2/s]; each command lasts for one sample.
    command_rate_v, command_rate_omega
        RMS of the rate of change of the command between ticks [m/s^2], [rad/s^2]; NaN for a run of one tick.
    """

    recovery_time_s: float
    overshoot_m: float
    lateral_max_m: float
    command_energy_v: float
    command_energy_omega: float
    command_rate_v: float
    command_rate_omega: float


def compute_recovery(
    time: FloatArray,
    lateral: FloatArray,
    command: FloatArray,
    sample_time: float,
    disturbance: tuple[float, float] | None,
    band: float,
    *,
    lost: bool = False,
) -> Recovery:
    """Compute the recovery of a run of n counted ticks, as defined in `Recovery`.

    Parameters
    ----------
    time
        (n,) times of the ticks [s].
    lateral
        (n,) signed distance from the path [m].
    command
        (n, 2) v [m/s], omega [rad/s].
    sample_time
        Duration of each command [s].
    disturbance
        Start of the first disturbance, and end of the last disturbance that ends during the run [s]; the end is
        infinite if no disturbance ends. None if there is no disturbance.
    band
        Half width of the lateral band [m].
    lost
        True if the run ended early.
    """
    recovery_time = overshoot = math.nan
    if disturbance is not None and np.isfinite(lateral).all():
        outside, (start, end) = np.abs(lateral) > band, disturbance
        if math.isfinite(end):
            recovery_time = math.inf if lost else _recovery_time(time, outside, end)
        overshoot = _overshoot(time, lateral, outside, start, end if math.isfinite(end) else start)
    energy = sample_time * np.sum(np.square(command), axis=0)
    changes = np.diff(command, axis=0) / sample_time
    rate = np.sqrt(np.mean(np.square(changes), axis=0)) if len(changes) else np.full(2, math.nan)
    return Recovery(recovery_time, overshoot, float(np.max(np.abs(lateral))), *energy.tolist(), *rate.tolist())


def _recovery_time(time: FloatArray, outside: NDArray[np.bool_], end: float) -> float:
    rows = np.flatnonzero(outside & (time >= end))
    if not rows.size:
        return 0.0
    return_row = int(rows[-1]) + 1
    return float(time[return_row] - end) if return_row < len(time) else math.inf


def _overshoot(time: FloatArray, lateral: FloatArray, outside: NDArray[np.bool_], start: float, end: float) -> float:
    during = np.flatnonzero(outside & (time >= start) & (time <= end))
    after = np.flatnonzero(outside & (time > end))
    if not during.size and not after.size:
        return 0.0
    excursion = int(during[-1]) if during.size else int(after[0])
    opposite = -np.sign(lateral[excursion]) * lateral
    # Values are negative until the robot crosses the path, so the time of the crossing is not needed.
    later_values = opposite[(np.arange(len(time)) > excursion) & (time >= end)]
    return float(max(0.0, np.max(later_values, initial=0.0)))
