"""The tables of the speed benchmark."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from diffdrive_mpc.bench.table import Table, number
from studies.speed.results import ACADOS, GROWTH_FROM, SpeedRecord, SpeedResults

_DETAILED = 30
"""The shipped horizon; a run without it shows its longest."""
_SMALLEST = "ssm"
"""The model with the fewest states, which others are held against."""
Value = Callable[[SpeedRecord], float]
Cell = Callable[[str, str, int], str]
"""Of solver, model and horizon."""


def _whole(record: SpeedRecord) -> float:
    return record.step_p50_s


def _inside(record: SpeedRecord) -> float:
    return record.solver_p50_s


def speed_tables(results: SpeedResults) -> list[Table]:
    """All tables, those that would be empty left out."""
    models = results.models
    tables = [_medians(results, model) for model in models]
    if ACADOS in results.solvers:
        own_clock, python = "inside its solver by its own clock", "from Python"
        tables += [_against_acados(results, model, "inside", own_clock, _inside) for model in models]
        tables += [_against_acados(results, model, "whole", python, _whole) for model in models]
    tables += [_tails(results, model) for model in models]
    tables += [_tails_by_horizon(results, model) for model in models]
    tables += [_exactness(results, model) for model in models]
    if _SMALLEST in models and len(models) > 1:
        tables.append(_models(results))
    tables.append(_growth(results))
    return tables + ([_missing(results)] if results.missing else [])


def detailed_horizon(results: SpeedResults) -> int:
    """The horizon that is looked at closely."""
    return _DETAILED if _DETAILED in results.horizons else results.horizons[-1]


def _by_horizon(
    results: SpeedResults, title: str, models: str | Sequence[str], cell: Cell, note: str, *, unit: str = ""
) -> Table:
    """A row for each solver, or for each of several models and solver; a column for each horizon."""

    def at(n: int) -> Callable[[tuple[str, str]], str]:
        return lambda of: cell(*of, n)

    columns = {f"N = {n}{unit}": at(n) for n in results.horizons}
    if isinstance(models, str):
        alone = [((solver,), (solver, models)) for solver in results.solvers]
        return Table.of(title, ("solver",), columns, alone, note)
    entries = [((model.upper(), solver), (solver, model)) for model in models for solver in results.solvers]
    return Table.of(title, ("model", "solver"), columns, entries, note)


def _medians(results: SpeedResults, model: str) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        whole, inside = (number(1e3 * results.value(solver, model, n, clock), 3) for clock in (_whole, _inside))
        return f"{whole}{'*' if results.value(solver, model, n, lambda r: r.clean_share) < 1 else ''} ({inside})"

    note = (
        "Whole step from Python, in brackets the time inside the solver. *: some steps could not be kept undisturbed."
    )
    return _by_horizon(results, f"Median step {model.upper()}", model, cell, note, unit=" [ms]")


def _against_acados(results: SpeedResults, model: str, clock: str, words: str, of_acados: Value) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        return number(results.value(solver, model, n, _whole) / results.value(ACADOS, model, n, of_acados), 2)

    note = f"Ratio of medians: the whole step over that of acados, {words}."
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
    note = "Whole steps of all repetitions; by tick: the median of its repetitions, what the data cause."
    return _detailed(results, "Tail", model, columns, note)


def _detailed(
    results: SpeedResults, title: str, model: str, columns: dict[str, Callable[[SpeedRecord], str]], note: str
) -> Table:
    """A row for each solver at the horizon that is looked at closely."""
    n = detailed_horizon(results)
    entries = [((solver,), record) for solver in results.solvers if (record := results.find(solver, model, n))]
    return Table.of(f"{title} {model.upper()}", ("solver",), columns, entries, f"N = {n}. {note}")


def _tails_by_horizon(results: SpeedResults, model: str) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        all_steps = results.value(solver, model, n, lambda r: r.step_p99_s / r.step_p50_s)
        by_tick = results.value(solver, model, n, lambda r: r.tick_p99_s / r.step_p50_s)
        return f"{number(all_steps, 1)} ({number(by_tick, 1)})"

    note = "p99 of the whole step over its median; in brackets with the median of a tick's repetitions in p99."
    return _by_horizon(results, f"Tail by horizon {model.upper()}", model, cell, note)


def _models(results: SpeedResults) -> Table:
    def cell(solver: str, model: str, n: int) -> str:
        return number(results.value(solver, model, n, _whole) / results.value(solver, _SMALLEST, n, _whole), 2)

    others = [model for model in results.models if model != _SMALLEST]
    note = f"Median of the whole step over that of the same solver with {_SMALLEST.upper()}."
    return _by_horizon(results, f"Against {_SMALLEST.upper()}", others, cell, note)


def _exactness(results: SpeedResults, model: str) -> Table:
    columns: dict[str, Callable[[SpeedRecord], str]] = {
        "v p50 [mm/s]": lambda r: f"{1e3 * r.gap_v_p50:.3f}",
        "v max [mm/s]": lambda r: f"{1e3 * r.gap_v_max:.3f}",
        "omega p50 [mrad/s]": lambda r: f"{1e3 * r.gap_omega_p50:.3f}",
        "omega max [mrad/s]": lambda r: f"{1e3 * r.gap_omega_max:.3f}",
        "cost": lambda r: number(r.closed_loop_cost, 5),
        "its": lambda r: number(r.iterations_p50, 0),
        "fails": lambda r: str(r.unsolved),
        "at limits [%]": lambda r: number(100 * r.active_share, 0),
    }
    note = (
        "Distance of the command from the converged one at the same state, p50 and maximum. Cost: of the closed loop, "
        "per tick. Its: median of the solver's iterations. Fails: ticks at which the solver gave up."
    )
    return _detailed(results, "Exactness", model, columns, note)


def _growth(results: SpeedResults) -> Table:
    longest = results.horizons[-1]

    def memory(solver: str) -> str:
        taken = [results.value(solver, model, longest, lambda r: r.memory_growth_bytes) for model in results.models]
        return number(max((value / 1e6 for value in taken if np.isfinite(value)), default=float("nan")), 0)

    columns: dict[str, Callable[[str], str]] = {
        f"exponent {model.upper()}": lambda solver, model=model: number(results.growth(solver, model), 2)  # type: ignore[misc]
        for model in results.models
    }
    columns[f"memory, N = {longest} [MB]"] = memory
    entries = [((solver,), solver) for solver in results.solvers]
    note = (
        f"Exponent of the median step over the horizon, from N = {GROWTH_FROM} on. Memory: what its process took "
        "beyond its loaded modules, at most."
    )
    return Table.of("Growth and memory", ("solver",), columns, entries, note)


def _missing(results: SpeedResults) -> Table:
    reasons: dict[tuple[str, str], list[str]] = {}
    for one in results.missing:
        reasons.setdefault((one.solver, one.reason), []).append(f"{one.model} {one.horizon}")
    rows = tuple((solver, ", ".join(where), reason) for (solver, reason), where in reasons.items())
    return Table("Missing", ("solver", "where", "reason"), rows, text_columns=3)
