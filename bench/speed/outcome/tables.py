"""The tables of the speed benchmark."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from diffdrive_mpc.bench.speed.outcome.record import Record
from diffdrive_mpc.bench.speed.outcome.results import ACADOS, GROWTH_FROM, SpeedResults
from diffdrive_mpc.bench.table import Table, number

_DETAILED = 30
"""The shipped horizon; a run without it shows its longest."""


_SMALLEST = "ssm"
"""The model with the fewest states, which others are held against."""
_CLOCKS = {"inside": "inside its solver by its own clock", "whole": "from Python"}


def speed_tables(results: SpeedResults) -> list[Table]:
    """All tables, those that would be empty left out."""
    tables = [_by_horizon(results, model) for model in results.models]
    if ACADOS in results.solvers:
        inside = lambda r: r.solver_p50_s  # noqa: E731 - a name for one of two columns
        whole = lambda r: r.step_p50_s  # noqa: E731
        tables += [_ratios(results, model, "inside", inside) for model in results.models]
        tables += [_ratios(results, model, "whole", whole) for model in results.models]
    tables += [_tails(results, model) for model in results.models]
    tables += [_tails_by_horizon(results, model) for model in results.models]
    tables += [_exactness(results, model) for model in results.models]
    if _SMALLEST in results.models and len(results.models) > 1:
        tables.append(_models(results))
    tables.append(_growth(results))
    if results.missing:
        tables.append(_missing(results))
    return tables


def detailed_horizon(results: SpeedResults) -> int:
    """The horizon that is looked at closely."""
    return _DETAILED if _DETAILED in results.horizons else results.horizons[-1]


def _by_horizon(results: SpeedResults, model: str) -> Table:
    rows = []
    for solver in results.solvers:
        whole = [1e3 * results.value(solver, model, n, lambda r: r.step_p50_s) for n in results.horizons]
        inside = [1e3 * results.value(solver, model, n, lambda r: r.solver_p50_s) for n in results.horizons]
        rows.append((solver, *(f"{number(w, 3)} ({number(i, 3)})" for w, i in zip(whole, inside, strict=True))))
    return Table(
        f"Median step {model.upper()}",
        ("solver", *(f"N = {n} [ms]" for n in results.horizons)),
        tuple(rows),
        note="Whole step from Python, in brackets the time inside the solver.",
    )


def _ratios(results: SpeedResults, model: str, clock: str, of_acados: Callable[[Record], float]) -> Table:
    rows = []
    for solver in results.solvers:
        ratios = [
            results.value(solver, model, n, lambda r: r.step_p50_s) / results.value(ACADOS, model, n, of_acados)
            for n in results.horizons
        ]
        rows.append((solver, *(number(ratio, 2) for ratio in ratios)))
    return Table(
        f"Against acados {clock} {model.upper()}",
        ("solver", *(f"N = {n}" for n in results.horizons)),
        tuple(rows),
        note=f"Ratio of medians: the whole step over that of acados, {_CLOCKS[clock]}.",
    )


def _tails(results: SpeedResults, model: str) -> Table:
    n = detailed_horizon(results)
    rows = []
    for solver in results.solvers:
        record = results.find(solver, model, n)
        if record is None:
            continue
        times = (record.step_p50_s, record.step_p95_s, record.step_p99_s, record.step_max_s)
        ticks = (record.tick_p99_s, record.tick_max_s)
        cells = [number(1e3 * time, 3) for time in (*times, *ticks)]
        rows.append((solver, *cells, number(record.step_p99_s / record.step_p50_s, 1)))
    return Table(
        f"Tail {model.upper()}",
        ("solver", "p50 [ms]", "p95 [ms]", "p99 [ms]", "max [ms]", "tick p99 [ms]", "tick max [ms]", "p99 / p50"),
        tuple(rows),
        note=f"N = {n}. Whole steps of all repetitions; by tick: the median of its repetitions, what the data cause.",
    )


def _tails_by_horizon(results: SpeedResults, model: str) -> Table:
    rows = []
    for solver in results.solvers:
        cells = []
        for n in results.horizons:
            all_steps = results.value(solver, model, n, lambda r: r.step_p99_s / r.step_p50_s)
            by_tick = results.value(solver, model, n, lambda r: r.tick_p99_s / r.step_p50_s)
            cells.append(f"{number(all_steps, 1)} ({number(by_tick, 1)})")
        rows.append((solver, *cells))
    return Table(
        f"Tail by horizon {model.upper()}",
        ("solver", *(f"N = {n}" for n in results.horizons)),
        tuple(rows),
        note="p99 of the whole step over its median; in brackets with the median of a tick's repetitions in p99.",
    )


def _models(results: SpeedResults) -> Table:
    rows = []
    for model in (model for model in results.models if model != _SMALLEST):
        for solver in results.solvers:
            ratios = [
                results.value(solver, model, n, lambda r: r.step_p50_s)
                / results.value(solver, _SMALLEST, n, lambda r: r.step_p50_s)
                for n in results.horizons
            ]
            rows.append((model.upper(), solver, *(number(ratio, 2) for ratio in ratios)))
    return Table(
        f"Against {_SMALLEST.upper()}",
        ("model", "solver", *(f"N = {n}" for n in results.horizons)),
        tuple(rows),
        text_columns=2,
        note=f"Median of the whole step over that of the same solver with {_SMALLEST.upper()}.",
    )


def _exactness(results: SpeedResults, model: str) -> Table:
    n = detailed_horizon(results)
    rows = []
    for solver in results.solvers:
        record = results.find(solver, model, n)
        if record is None:
            continue
        gaps = (record.gap_v_p50, record.gap_v_max, record.gap_omega_p50, record.gap_omega_max)
        rows.append(
            (
                solver,
                *(f"{1e3 * gap:.3f}" for gap in gaps),
                number(record.closed_loop_cost, 5),
                number(record.iterations_p50, 0),
                str(record.unsolved),
                number(100 * record.active_share, 0),
            )
        )
    return Table(
        f"Exactness {model.upper()}",
        (
            "solver",
            "v p50 [mm/s]",
            "v max [mm/s]",
            "omega p50 [mrad/s]",
            "omega max [mrad/s]",
            "cost",
            "its",
            "fails",
            "at limits [%]",
        ),
        tuple(rows),
        note=f"N = {n}. Distance of the command from the converged one at the same state, p50 and maximum. Cost: of "
        "the closed loop, per tick. Its: median of the solver's iterations. Fails: ticks at which the solver gave up.",
    )


def _growth(results: SpeedResults) -> Table:
    rows = []
    longest = results.horizons[-1]
    for solver in results.solvers:
        exponents = (number(results.growth(solver, model), 2) for model in results.models)
        memory = [
            results.value(solver, model, longest, lambda r: r.memory_growth_bytes) / 1e6 for model in results.models
        ]
        finite = [value for value in memory if np.isfinite(value)]
        rows.append((solver, *exponents, number(max(finite, default=float("nan")), 0)))
    return Table(
        "Growth and memory",
        ("solver", *(f"exponent {model.upper()}" for model in results.models), f"memory, N = {longest} [MB]"),
        tuple(rows),
        note=f"Exponent of the median step over the horizon, from N = {GROWTH_FROM} on. Memory: what its process took "
        "beyond its loaded modules, at most.",
    )


def _missing(results: SpeedResults) -> Table:
    reasons: dict[tuple[str, str], list[str]] = {}
    for one in results.missing:
        reasons.setdefault((one.solver, one.reason), []).append(f"{one.model} {one.horizon}")
    rows = tuple((solver, ", ".join(where), reason) for (solver, reason), where in reasons.items())
    return Table("Missing", ("solver", "where", "reason"), rows, text_columns=3)
