"""Cells of tables over groups of outcomes: each function makes what gives the cells of one column."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from diffdrive_mpc.bench.outcomes import Scored, count, mean, recoveries, worst
from diffdrive_mpc.bench.table import duration, number

Cell = Callable[[Sequence[Any]], str]
"""From a group of outcomes to a cell."""


def millis(value: float) -> str:
    """A cell in thousandths of its unit."""
    return number(1e3 * value, 1)


def mean_of(metric: str, write: Callable[[float], str] = number) -> Cell:
    """Mean of a metric."""
    return lambda group: write(mean(group, metric))


def worst_of(metric: str, write: Callable[[float], str] = number) -> Cell:
    """Largest value of a metric."""
    return lambda group: write(worst(group, metric))


def total_of(metric: str) -> Cell:
    """Sum of a metric that counts."""
    return lambda group: str(count(group, metric))


def share_of(way: str) -> Cell:
    """Mean share of the solved ticks that one way of the solver took."""
    return lambda group: number(float(np.mean([getattr(one.shares, way) for one in group])), 1)


def completed(group: Sequence[Scored]) -> str:
    """How many runs completed, of how many."""
    return f"{count(group, 'completed')}/{len(group)}"


def time_behind(group: Sequence[Scored]) -> str:
    """Mean over runs of the largest time behind the reference [s]."""
    return number(mean(group, "behind_max_s"), 2)


def command_rate(channel: str) -> Cell:
    """Mean of the RMS rate of a command, "v" [m/s^2] or "omega" [rad/s^2], over the runs that have one."""

    def cell(group: Sequence[Scored]) -> str:
        rates = recoveries(group, f"command_rate_{channel}")
        known = rates[np.isfinite(rates)]
        return number(float(np.mean(known)) if known.size else float("nan"), 2)

    return cell


def recovered(group: Sequence[Scored]) -> str:
    """How many runs recovered, of how many; "-" where the disturbance lasts."""
    times = recoveries(group, "recovery_time_s")
    return "-" if np.isnan(times).all() else f"{np.count_nonzero(np.isfinite(times))}/{len(group)}"


def recovery_columns(names: Sequence[str], write: Callable[[float], str] = number) -> dict[str, Cell]:
    """Mean and longest recovery, largest overshoot and lateral error, mean energies of both commands, under `names`."""

    def of(figure: str, statistic: Callable[..., Any], cell: Callable[[float], str]) -> Cell:
        return lambda group: cell(float(statistic(recoveries(group, figure))))

    energy = partial(number, digits=2)
    cells = (
        of("recovery_time_s", np.mean, duration),
        of("recovery_time_s", np.max, duration),
        of("overshoot_m", np.max, write),
        worst_of("lateral_max_m", write),
        of("command_energy_v", np.mean, energy),
        of("command_energy_omega", np.mean, energy),
    )
    return dict(zip(names, cells, strict=True))
