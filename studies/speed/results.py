"""Results of the speed benchmark and their tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray

ACADOS = "acados"
"""Name of the peer to which the step times of other solvers are compared."""
MIN_GROWTH_HORIZON = 20
"""Minimum horizon for the growth exponent; at shorter horizons, costs that do not depend on the horizon dominate."""


@dataclass(frozen=True, eq=False)
class SpeedRecord:
    """Result of one subject on one problem; a record of `speed.json`.

    Attributes
    ----------
    solver, model, horizon
        Names of solver and model, and horizon.
    step_p50_s, step_p95_s, step_p99_s, step_max_s
        Time of the whole step from Python [s], over all ticks of all repetitions.
    tick_p99_s, tick_max_s
        Percentile and maximum over ticks of the median over repetitions [s]; short disturbances do not affect them.
    solver_p50_s, solver_p95_s, solver_p99_s, solver_max_s
        Time inside the solver, as reported by the solver [s].
    iterations_p50, iterations_max
        Iterations of the solver.
    closed_loop_cost
        Cost of the closed loop per tick, see `studies.speed.measure.closed_loop_cost`.
    gap_v_p50, gap_v_max, gap_omega_p50, gap_omega_max
        Distance between the command and the command of the converged solution at the same state [m/s, rad/s].
    active_share
        Share of ticks at which a hard limit of range or slew is active [-].
    unsolved
        Number of ticks at which the solver failed.
    samples, clean_share, ticks
        Number of timed steps, share of undisturbed steps, and number of ticks of the drive.
    build_s, memory_bytes, memory_growth_bytes
        Build time [s]; maximum memory of the process, and its increase after the import of the modules [bytes].
    whole
        Times of the whole step (repetitions, ticks) [s]; NaN if disturbed or with cold caches; not written to the file.
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
        """Convert to values of JSON; times are rounded to nanoseconds."""
        values = {member.name: getattr(self, member.name) for member in fields(self) if member.name != "whole"}
        return {name: round(value, 9) if isinstance(value, float) else value for name, value in values.items()}


@dataclass(frozen=True)
class Missing:
    """Subject that could not run, with the reason."""

    solver: str
    model: str
    horizon: int
    reason: str


def time_statistics(whole: FloatArray, inside: FloatArray) -> dict[str, float]:
    """Compute the time statistics of a record from times (repetitions, ticks) [s]; NaN values are ignored."""
    ticks = np.nanmedian(whole[:, np.isfinite(whole).any(axis=0)], axis=0)
    statistics = {"tick_p99_s": float(np.percentile(ticks, 99)), "tick_max_s": float(ticks.max())}
    for name, times in (("step", whole), ("solver", inside)):
        for percent in (50, 95, 99):
            statistics[f"{name}_p{percent}_s"] = float(np.nanpercentile(times, percent))
        statistics[f"{name}_max_s"] = float(np.nanmax(times))
    return statistics


def growth_exponent(horizons: FloatArray, times: FloatArray) -> float:
    """Fit the exponent e in times = c horizons^e by least squares of logarithms; NaN for fewer than two horizons."""
    if len(horizons) < 2:
        return float("nan")
    return float(np.polyfit(np.log(horizons), np.log(times), 1)[0])


@dataclass(frozen=True)
class SpeedResults:
    """Records of the benchmark, and missing subjects.

    Attributes
    ----------
    records, missing
        Records and missing subjects in the order of the run.
    core
        Processor core of all subjects; None if the system cannot bind a process to a core.
    load
        Number of running processes on the machine before and after the benchmark.
    """

    records: tuple[SpeedRecord, ...]
    missing: tuple[Missing, ...]
    core: int | None = None
    load: tuple[float, float] = (math.nan, math.nan)

    @property
    def models(self) -> tuple[str, ...]:
        """Models in order of first appearance."""
        return tuple(dict.fromkeys(record.model for record in self.records))

    @property
    def horizons(self) -> tuple[int, ...]:
        """Horizons in ascending order."""
        return tuple(sorted({record.horizon for record in self.records}))

    @property
    def solvers(self) -> tuple[str, ...]:
        """Solvers with at least one record, in order of first appearance."""
        return tuple(dict.fromkeys(record.solver for record in self.records))

    def find(self, solver: str, model: str, horizon: int) -> SpeedRecord | None:
        """Return the record of a solver, model and horizon, or None if there is no such record."""
        key = (solver, model, horizon)
        return next((r for r in self.records if (r.solver, r.model, r.horizon) == key), None)

    def value(self, solver: str, model: str, horizon: int, field: Callable[[SpeedRecord], float]) -> float:
        """Return a value of the record of a solver, model and horizon; NaN if there is no such record."""
        record = self.find(solver, model, horizon)
        return float("nan") if record is None else field(record)

    def growth(self, solver: str, model: str) -> float:
        """Fit `growth_exponent` to the median steps at horizons of at least `MIN_GROWTH_HORIZON`."""
        records = [
            r for r in self.records if (r.solver, r.model) == (solver, model) and r.horizon >= MIN_GROWTH_HORIZON
        ]
        return growth_exponent(
            np.array([r.horizon for r in records], dtype=float), np.array([r.step_p50_s for r in records])
        )

    def as_json(self) -> dict[str, object]:
        """Convert to `{"records": [...], "missing": [...], "growth": [...]}` with values of JSON."""
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


# Tables of the speed benchmark.


_DETAIL_HORIZON = 30
"""Horizon of the detailed tables, which is that of the shipped configuration, if it is in the results."""
_BASE_MODEL = "ssm"
"""Model with the minimum number of states, to which other models are compared."""
Value = Callable[[SpeedRecord], float]
Cell = Callable[[str, str, int], str]
"""Function that formats a cell from solver, model and horizon."""


def _whole(record: SpeedRecord) -> float:
    return record.step_p50_s


def _inside(record: SpeedRecord) -> float:
    return record.solver_p50_s


def speed_tables(results: SpeedResults) -> list[Table]:
    """Build the tables of the report."""
    models = results.models
    tables = [_medians(results, model) for model in models]
    if ACADOS in results.solvers:
        solver_clock, step_clock = "inside its solver as reported by acados", "from Python"
        tables += [_against_acados(results, model, "inside", solver_clock, _inside) for model in models]
        tables += [_against_acados(results, model, "whole", step_clock, _whole) for model in models]
    tables += [_tails(results, model) for model in models]
    tables += [_tails_by_horizon(results, model) for model in models]
    tables += [_exactness(results, model) for model in models]
    if _BASE_MODEL in models and len(models) > 1:
        tables.append(_models(results))
    tables.append(_growth(results))
    return tables + ([_missing(results)] if results.missing else [])


def detailed_horizon(results: SpeedResults) -> int:
    """Return the horizon of the detailed tables: `_DETAIL_HORIZON`, or the longest horizon if it was not run."""
    return _DETAIL_HORIZON if _DETAIL_HORIZON in results.horizons else results.horizons[-1]


def _by_horizon(
    results: SpeedResults, title: str, models: str | Sequence[str], cell: Cell, note: str, *, unit: str = ""
) -> Table:
    """Build a table with a row per solver, or per model and solver, and a column per horizon."""

    def cell_at(n: int) -> Callable[[tuple[str, str]], str]:
        return lambda key: cell(*key, n)

    columns = {f"N = {n}{unit}": cell_at(n) for n in results.horizons}
    if isinstance(models, str):
        solver_rows = [((solver,), (solver, models)) for solver in results.solvers]
        return Table.build(title, ("solver",), columns, solver_rows, note)
    entries = [((model.upper(), solver), (solver, model)) for model in models for solver in results.solvers]
    return Table.build(title, ("model", "solver"), columns, entries, note)


def _medians(results: SpeedResults, model: str) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        whole, inside = (number(1e3 * results.value(solver, model, n, clock), 3) for clock in (_whole, _inside))
        return f"{whole}{'*' if results.value(solver, model, n, lambda r: r.clean_share) < 1 else ''} ({inside})"

    note = "Whole step from Python, in brackets the time inside the solver. *: some steps were disturbed."
    return _by_horizon(results, f"Median step {model.upper()}", model, cell, note, unit=" [ms]")


def _against_acados(results: SpeedResults, model: str, clock: str, description: str, acados_time: Value) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        return number(results.value(solver, model, n, _whole) / results.value(ACADOS, model, n, acados_time), 2)

    note = f"Ratio of medians: whole step over the time of acados, {description}."
    return _by_horizon(results, f"Against acados {clock} {model.upper()}", model, cell, note)


def _tails(results: SpeedResults, model: str) -> Table:
    def millis(value: Value) -> Callable[[SpeedRecord], str]:
        return lambda record: number(1e3 * value(record), 3)

    columns = {
        "p50 [ms]": millis(_whole),
        "p95 [ms]": millis(lambda r: r.step_p95_s),
        "p99 [ms]": millis(lambda r: r.step_p99_s),
        "max [ms]": millis(lambda r: r.step_max_s),
        "tick p99 [ms]": millis(lambda r: r.tick_p99_s),
        "tick max [ms]": millis(lambda r: r.tick_max_s),
        "p99 / p50": lambda r: number(r.step_p99_s / r.step_p50_s, 1),
    }
    note = "Whole steps of all repetitions. Tick: statistics of the median over repetitions, without disturbances."
    return _detail_table(results, "Tail", model, columns, note)


def _detail_table(
    results: SpeedResults, title: str, model: str, columns: dict[str, Callable[[SpeedRecord], str]], note: str
) -> Table:
    """Build a table with a row per solver at the detailed horizon."""
    n = detailed_horizon(results)
    entries = [((solver,), record) for solver in results.solvers if (record := results.find(solver, model, n))]
    return Table.build(f"{title} {model.upper()}", ("solver",), columns, entries, f"N = {n}. {note}")


def _tails_by_horizon(results: SpeedResults, model: str) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        all_steps = results.value(solver, model, n, lambda r: r.step_p99_s / r.step_p50_s)
        by_tick = results.value(solver, model, n, lambda r: r.tick_p99_s / r.step_p50_s)
        return f"{number(all_steps, 1)} ({number(by_tick, 1)})"

    note = "p99 of the whole step over its median; in brackets, p99 over ticks of the median over repetitions."
    return _by_horizon(results, f"Tail by horizon {model.upper()}", model, cell, note)


def _models(results: SpeedResults) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        return number(results.value(solver, model, n, _whole) / results.value(solver, _BASE_MODEL, n, _whole), 2)

    others = [model for model in results.models if model != _BASE_MODEL]
    note = f"Median of the whole step, relative to the same solver with {_BASE_MODEL.upper()}."
    return _by_horizon(results, f"Against {_BASE_MODEL.upper()}", others, cell, note)


def _exactness(results: SpeedResults, model: str) -> Table:
    columns: dict[str, Callable[[SpeedRecord], str]] = {
        "v p50 [mm/s]": lambda r: f"{1e3 * r.gap_v_p50:.3f}",
        "v max [mm/s]": lambda r: f"{1e3 * r.gap_v_max:.3f}",
        "omega p50 [mrad/s]": lambda r: f"{1e3 * r.gap_omega_p50:.3f}",
        "omega max [mrad/s]": lambda r: f"{1e3 * r.gap_omega_max:.3f}",
        "cost": lambda r: number(r.closed_loop_cost, 5),
        "iterations": lambda r: number(r.iterations_p50, 0),
        "failures": lambda r: str(r.unsolved),
        "at limits [%]": lambda r: number(100 * r.active_share, 0),
    }
    note = (
        "Distance of the command from the converged command at the same state, p50 and maximum. Cost: closed-loop cost "
        "per tick. Iterations: median of the solver's iterations. Failures: ticks at which the solver failed."
    )
    return _detail_table(results, "Exactness", model, columns, note)


def _growth(results: SpeedResults) -> Table:
    longest = results.horizons[-1]

    def memory(solver: str) -> str:
        growths = [results.value(solver, model, longest, lambda r: r.memory_growth_bytes) for model in results.models]
        return number(max((value / 1e6 for value in growths if np.isfinite(value)), default=float("nan")), 0)

    columns: dict[str, Callable[[str], str]] = {
        f"exponent {model.upper()}": lambda solver, model=model: number(results.growth(solver, model), 2)  # type: ignore[misc]
        for model in results.models
    }
    columns[f"memory, N = {longest} [MB]"] = memory
    entries = [((solver,), solver) for solver in results.solvers]
    note = (
        f"Exponent of the median step over the horizon, for N of at least {MIN_GROWTH_HORIZON}. Memory: maximum memory "
        "of the process in addition to its loaded modules."
    )
    return Table.build("Growth and memory", ("solver",), columns, entries, note)


def _missing(results: SpeedResults) -> Table:
    reasons: dict[tuple[str, str], list[str]] = {}
    for entry in results.missing:
        reasons.setdefault((entry.solver, entry.reason), []).append(f"{entry.model} {entry.horizon}")
    rows = tuple((solver, ", ".join(problems), reason) for (solver, reason), problems in reasons.items())
    return Table("Missing", ("solver", "where", "reason"), rows, text_columns=3)
