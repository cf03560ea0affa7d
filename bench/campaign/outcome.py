"""The row of a run: metrics, completion, counts of what the controller did, unsafe commands, and times."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from diffdrive_mpc.bench.command_check import Unsafe
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.run_row import CLOCK, run_columns
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.sim import Run

TIME = "time_"
"""Beginning of the names of all columns that differ when a run is repeated."""
_WORDS = {str(status): f"solver_{status.name.lower()}" for status in SolverStatus}

Row = dict[str, bool | int | float | str | None]


def row_of(run: Run | None, unsafe: Unsafe | None, error: str, processor: float, wall: float) -> Row:
    """The row of one run.

    Parameters
    ----------
    run
        What was driven; None where it ended in an error.
    unsafe
        Counts by the checker; None where the controller is not this project's.
    error
        Why it could not be driven or driven on, in one line; empty where it could.
    processor, wall
        What it took of the processor and of the clock [s].
    """
    row: Row = {"completed": run is not None and run.metrics.completed, "error": error}
    row |= {f"unsafe_{name}": count for name, count in (asdict(unsafe) if unsafe else {}).items()}
    row |= {f"{TIME}processor_s": processor, f"{TIME}wall_s": wall}
    if run is None:
        return row
    for name, value in plain(run_columns(run)).items():
        row[f"{TIME}{name.replace('_time', '')}" if name.startswith(CLOCK) else name] = value
    modes, statuses = Counter(run.modes), Counter(run.solver_statuses)
    row |= {f"ticks_{mode.lower()}": modes[mode] for mode in Mode}
    return row | {column: statuses[words] for words, column in _WORDS.items()}
