"""Time per step and memory."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.bench.reproduce.experiments.cost import Cost
from diffdrive_mpc.bench.reproduce.published import Published
from diffdrive_mpc.bench.table import Table

_ROUNDING = 1e-9


def cost_table(cost: Mapping[str, Cost], published: Published) -> Table:
    """Mean and standard deviation over runs, in microseconds and kilobytes."""
    rows = []
    for name, ours in cost.items():
        paper = published.cost[name]
        cells = [_pair(paper.time_per_step, 1e6), _pair(ours.time_per_step, 1e6)]
        cells += [_pair(paper.memory, 1e3), _pair(ours.memory, 1e3)]
        rows.append((name.upper(), str(ours.order), *cells))
    columns = (
        "model",
        "states",
        "published time per step [us]",
        "time per step [us]",
        "published memory [kB]",
        "memory [kB]",
    )
    note = (
        "Mean ± standard deviation over runs. Published: P0, Table 3 (MBM and SM in Simulink; its Table 4 prints 32 MB "
        "and 5.3 MB for what Table 3 gives as 0.032 and 0.0053 MB); P1, Table 5 (SSM). Ours: from commands "
        "to poses, one process, one BLAS thread, processor time; memory is the most held at a time."
    )
    return Table("Cost of a simulation", columns, tuple(rows), note=note)


def _pair(values: tuple[float, float], factor: float) -> str:
    mean, deviation = (factor * value for value in values)
    # Runs that hold the same amount differ by rounding of the mean only.
    return f"{mean:.3g} ± {deviation:.2g}" if deviation > _ROUNDING * mean else f"{mean:.3g} ± 0"
