"""What is known of one subject on one problem, and what the whole benchmark gave."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

ACADOS = "acados"
"""The peer that ratios refer to."""
GROWTH_FROM = 20
"""Shortest horizon that counts for the growth: below it what does not depend on the horizon prevails."""


@dataclass(frozen=True, eq=False)
class SpeedRecord:
    """One line of `speed.json`.

    Attributes
    ----------
    solver, model, horizon
        Who solved what.
    step_p50_s, step_p95_s, step_p99_s, step_max_s
        Time of the whole step from Python [s], over all ticks of all repetitions.
    tick_p99_s, tick_max_s
        The same over the ticks, each with the median of its repetitions: what the data cause, without what else the
        machine did.
    solver_p50_s, solver_p95_s, solver_p99_s, solver_max_s
        Time inside the solver by its own clock [s].
    iterations_p50, iterations_max
        Iterations of the solver.
    closed_loop_cost
        See `studies.speed.closed_loop_cost`.
    gap_v_p50, gap_v_max, gap_omega_p50, gap_omega_max
        Distance of the command from that of the converged solution at the same state [m/s, rad/s].
    active_share
        Share of ticks at which the command stood at a hard limit of range or slew.
    unsolved
        Ticks at which the solver gave up.
    samples, clean_share, ticks
        Steps that were timed, the share of them that were undisturbed, and ticks of the drive.
    build_s, memory_bytes, memory_growth_bytes
        Time to set it up [s]; the largest memory of its process, and by how much it grew since its modules were loaded.
    whole
        (repetitions, ticks) times of the whole step [s], NaN where it was disturbed or cold, for the figure of the
        tail; not written.
    """

    solver: str
    model: str
    horizon: int
    step_p50_s: float
    step_p95_s: float
    step_p99_s: float
    step_max_s: float
    tick_p99_s: float
    tick_max_s: float
    solver_p50_s: float
    solver_p95_s: float
    solver_p99_s: float
    solver_max_s: float
    iterations_p50: float
    iterations_max: int
    closed_loop_cost: float
    gap_v_p50: float
    gap_v_max: float
    gap_omega_p50: float
    gap_omega_max: float
    active_share: float
    unsolved: int
    samples: int
    clean_share: float
    ticks: int
    build_s: float
    memory_bytes: float
    memory_growth_bytes: float
    whole: FloatArray = field(repr=False)

    def as_json(self) -> dict[str, object]:
        """Plain values; times to the nanosecond."""
        written = {of.name: getattr(self, of.name) for of in fields(self) if of.name != "whole"}
        return {name: round(value, 9) if isinstance(value, float) else value for name, value in written.items()}


@dataclass(frozen=True)
class Missing:
    """A subject that could not be run, and why."""

    solver: str
    model: str
    horizon: int
    reason: str


def time_statistics(whole: FloatArray, inside: FloatArray) -> dict[str, float]:
    """Percentiles of times (repetitions, ticks) [s] under the names of a record's fields; what is NaN is left out."""
    ticks = np.nanmedian(whole[:, np.isfinite(whole).any(axis=0)], axis=0)
    statistics = {"tick_p99_s": float(np.percentile(ticks, 99)), "tick_max_s": float(ticks.max())}
    for name, times in (("step", whole), ("solver", inside)):
        for percent in (50, 95, 99):
            statistics[f"{name}_p{percent}_s"] = float(np.nanpercentile(times, percent))
        statistics[f"{name}_max_s"] = float(np.nanmax(times))
    return statistics


def growth_exponent(horizons: FloatArray, times: FloatArray) -> float:
    """Exponent e of times = c horizons^e, by least squares of the logarithms; NaN with fewer than two horizons."""
    if len(horizons) < 2:
        return float("nan")
    return float(np.polyfit(np.log(horizons), np.log(times), 1)[0])


@dataclass(frozen=True)
class SpeedResults:
    """Records, the times behind them, and who is missing.

    Attributes
    ----------
    records, missing
        In the order of the run.
    core
        The core that everybody ran on; None where a process cannot be bound to one.
    load
        Processes that ran on the machine before and after.
    """

    records: tuple[SpeedRecord, ...]
    missing: tuple[Missing, ...]
    core: int | None = None
    load: tuple[float, float] = (math.nan, math.nan)

    @property
    def models(self) -> tuple[str, ...]:
        """Models, in order of appearance."""
        return tuple(dict.fromkeys(record.model for record in self.records))

    @property
    def horizons(self) -> tuple[int, ...]:
        """Horizons, ascending."""
        return tuple(sorted({record.horizon for record in self.records}))

    @property
    def solvers(self) -> tuple[str, ...]:
        """Solvers, in order of appearance, those that are missing everywhere left out."""
        return tuple(dict.fromkeys(record.solver for record in self.records))

    def find(self, solver: str, model: str, horizon: int) -> SpeedRecord | None:
        """One record, if there is one."""
        wanted = (solver, model, horizon)
        return next((r for r in self.records if (r.solver, r.model, r.horizon) == wanted), None)

    def value(self, solver: str, model: str, horizon: int, field: Callable[[SpeedRecord], float]) -> float:
        """A value of one record; NaN if there is none."""
        record = self.find(solver, model, horizon)
        return float("nan") if record is None else field(record)

    def growth(self, solver: str, model: str) -> float:
        """Exponent of the whole step's median over the horizons from `GROWTH_FROM` on; NaN with fewer than two."""
        found = [r for r in self.records if (r.solver, r.model) == (solver, model) and r.horizon >= GROWTH_FROM]
        return growth_exponent(
            np.array([r.horizon for r in found], dtype=float), np.array([r.step_p50_s for r in found])
        )

    def as_json(self) -> dict[str, object]:
        """`{"records": [...], "missing": [...], "growth": [...]}` of plain values."""
        growth = [
            {"solver": solver, "model": model, "exponent": round(exponent, 3)}
            for model in self.models
            for solver in self.solvers
            if np.isfinite(exponent := self.growth(solver, model))
        ]
        return {
            "records": [record.as_json() for record in self.records],
            "missing": [asdict(missing) for missing in self.missing],
            "growth": growth,
        }
