"""Recovery of a run after a disturbance: return to the path, and control effort.

Every error is that of the true pose, so it carries no measurement noise; the lateral band separates ordinary tracking
errors of a few millimetres (Guffanti et al. 2026, PMC12845739): only errors beyond the band are an excursion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import TextTable


@dataclass(frozen=True, slots=True)
class Recovery:
    """Figures of one run; the field names are those of `bench.json`, units in their endings.

    Attributes
    ----------
    recovery_time_s
        From the end of the disturbance to the first tick from which |lateral| stays inside the band to the end of the
        reference. 0 where it never leaves the band after that end; infinity where the reference ends with the robot
        outside, or the run before the reference. NaN without a disturbance that ends, or where the lateral error is
        not finite.
    overshoot_m
        Largest distance from the path on the other side than the excursion, from when both the excursion and the
        disturbance have been. The excursion is the last tick outside the band between begin and end of the
        disturbance, or else the first one after that; of a disturbance that lasts, the first one since its begin.
        0 without excursion, or where the robot never gets to the other side; NaN without a disturbance, or where the
        lateral error is not finite. Ordinary tracking errors on the other side are part of it.
    lateral_max_m
        Largest |lateral| of the run.
    command_energy_v, command_energy_omega
        Integral of the squared command over the counted ticks, each held for one sample [m^2/s], [rad^2/s].
    command_rate_v, command_rate_omega
        Root mean square of the command's change from tick to tick over the sample time [m/s^2], [rad/s^2]; NaN for a
        run of one tick.
    """

    recovery_time_s: float
    overshoot_m: float
    lateral_max_m: float
    command_energy_v: float
    command_energy_omega: float
    command_rate_v: float
    command_rate_omega: float

    def __str__(self) -> str:
        """Format a table: "-" for missing values, "inf" if the robot did not return."""
        rows = (
            ("recovery time [s]", self.recovery_time_s),
            ("overshoot [m]", self.overshoot_m),
            ("largest |lateral| [m]", self.lateral_max_m),
            ("energy of v_ref [m^2/s]", self.command_energy_v),
            ("energy of omega_ref [rad^2/s]", self.command_energy_omega),
            ("rate of v_ref, RMS [m/s^2]", self.command_rate_v),
            ("rate of omega_ref, RMS [rad/s^2]", self.command_rate_omega),
        )
        cells = tuple((name, "-" if math.isnan(value) else f"{value:.4g}") for name, value in rows)
        return str(TextTable("", ("recovery", "value"), cells))


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
        (n,) instants [s].
    lateral
        (n,) signed distance from the path [m].
    command
        (n, 2) v [m/s], omega [rad/s].
    sample_time
        Time for which each command is held [s].
    disturbance
        Start of the first disturbance, and end of the last one that ends [s], infinity where all of them last to the
        end of the run; None without one.
    band
        Half width of the lateral band [m].
    lost
        Whether the run ended before its time.
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
    late = np.flatnonzero(outside & (time >= end))
    if not late.size:
        return 0.0
    back = int(late[-1]) + 1
    return float(time[back] - end) if back < len(time) else math.inf


def _overshoot(time: FloatArray, lateral: FloatArray, outside: NDArray[np.bool_], start: float, end: float) -> float:
    during = np.flatnonzero(outside & (time >= start) & (time <= end))
    after = np.flatnonzero(outside & (time > end))
    if not during.size and not after.size:
        return 0.0
    excursion = int(during[-1]) if during.size else int(after[0])
    beyond = -np.sign(lateral[excursion]) * lateral
    # There is no overshoot before the path is crossed, so the crossing need not be searched.
    counted = beyond[(np.arange(len(time)) > excursion) & (time >= end)]
    return float(max(0.0, np.max(counted, initial=0.0)))
