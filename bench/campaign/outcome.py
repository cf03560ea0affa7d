"""The row of a run: metrics, completion, counts of what the controller did, unsafe commands, and times."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

from diffdrive_mpc.bench.command_check import Unsafe
from diffdrive_mpc.bench.outcomes import SolverShares, plain
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.sim import Run

TIME = "time_"
"""Beginning of the names of all columns that differ when a run is repeated."""
_BY_THE_CLOCK = ("step_time", "solve_time", "deadline")
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
    metrics = plain(asdict(run.metrics))
    for name, value in metrics.items():
        clock = name.startswith(_BY_THE_CLOCK)
        row[f"{TIME}{name.replace('_time', '')}" if clock else name] = value
    row["driven_s"] = float(run.time[-1])
    row |= {"ended": run.ended, "last_mode": run.modes[-1]}
    row |= plain(asdict(SolverShares.of(run)))
    said = Counter(message for message in run.messages if message)
    row["message"] = said.most_common(1)[0][0] if said else ""
    row["message_percent"] = 100.0 * said.total() / len(run.messages)
    modes, statuses = Counter(run.modes), Counter(run.solver_statuses)
    row |= {f"ticks_{mode.lower()}": modes[mode] for mode in Mode}
    row |= {column: statuses[words] for words, column in _WORDS.items()}
    recovery = plain(asdict(run.recovery))
    row |= {f"recovery_{name.removeprefix('recovery_')}": value for name, value in recovery.items()}
    return row
