"""The drive over DDS beside the simulation in one process, with the same seed.

`minute.yaml` beside this file is a trajectory long enough for figures of jitter and latency.

Run as ``python -m studies.ros.compare [--real-time] [--page] [--model MODEL] [--seed SEED]
[TRAJECTORY ...]``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.sim import Run, simulate
from studies.documents.documents import insert, measured_on
from studies.ros.recorded_drive import LoopTiming, loop_timing, read_drive
from studies.ros.two_processes import drive_over_dds

TRAJECTORIES = ("circle", "s")
PAGE = Path("docs/robot.md")
COMPARED = ("position_rmse_m", "lateral_rmse_m", "heading_rmse_rad", "position_max_m")
"""Statistics that are set side by side."""


@dataclass(frozen=True)
class RosComparison:
    """One trajectory both ways.

    Attributes
    ----------
    case
        What was driven.
    over_dds, in_process
        The two runs.
    timing
        Of the loop over DDS; says something in real time only.
    """

    case: Case
    over_dds: Run
    in_process: Run
    timing: LoopTiming

    def ratio(self, statistic: str) -> float:
        """A statistic over DDS over that in one process."""
        return float(getattr(self.over_dds.metrics, statistic) / getattr(self.in_process.metrics, statistic))


def compare(
    case: Case, *, lock_step: bool = True, timeout: float = 300.0, settings: Path | None = None
) -> RosComparison:
    """Drive `case` over DDS and in one process.

    Parameters
    ----------
    case
        Of the controller "mpc".
    lock_step
        Whether clock and commands take turns over DDS; otherwise in real time.
    timeout
        Longest time that the drive over DDS may take [s].
    settings
        Of the simulated base, in place of the shipped ones.

    Raises DriveFailedError if a process fails or takes too long; ConfigError if a name or a file cannot be used, or the
    drive is not complete.
    """
    controller, plant, reference = build(case)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "drive"
        drive_over_dds(case, reference.duration, bag, lock_step=lock_step, timeout=timeout, settings=settings)
        over_dds = read_drive(bag, reference, plant.sample_time)
        timing = loop_timing(bag, plant.sample_time)
    return RosComparison(case, over_dds, simulate(controller, plant, reference), timing)


def comparison_table(comparisons: Sequence[RosComparison]) -> Table:
    """Statistics over DDS, in one process, and the one over the other."""
    columns: dict[str, Callable[[tuple[RosComparison, str]], str]] = {
        "over DDS": lambda of: f"{getattr(of[0].over_dds.metrics, of[1]):.4f}",
        "one process": lambda of: f"{getattr(of[0].in_process.metrics, of[1]):.4f}",
        "ratio": lambda of: f"{of[0].ratio(of[1]):.2f}",
    }
    names = {of: " [".join(of.replace("rmse", "RMSE").rsplit("_", 1)).replace("_", " ") + "]" for of in COMPARED}
    entries = [
        ((comparison.case.labels["trajectory"], names[of]), (comparison, of))
        for comparison in comparisons
        for of in COMPARED
    ]
    return Table.of("Over DDS and in one process", ("trajectory", "error"), columns, entries)


def timing_table(comparisons: Sequence[RosComparison]) -> Table:
    """Control period and latency of the drives over DDS, in milliseconds."""
    rows = []
    for item in comparisons:
        timing = item.timing
        named = (("period", timing.period), ("jitter", timing.jitter), ("odometry to command", timing.latency))
        for name, spread in named:
            times = (f"{1e3 * value:.2f}" for value in (spread.p50, spread.p99, spread.max))
            rows.append((item.case.labels["trajectory"], name, *times, f"{timing.misses} of {timing.commands}"))
    columns = ("trajectory", "time", "p50 [ms]", "p99 [ms]", "max [ms]", "missed periods")
    return Table("Times over DDS", columns, tuple(rows), 2)


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.ros.compare",
        description="The drive over DDS beside that in one process",
    )
    parser.add_argument("trajectories", nargs="*", default=TRAJECTORIES, help="names or paths")
    parser.add_argument("--model", default="ssm")
    parser.add_argument("--sensors", default="default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--page", action="store_true", help=f"write the tables into {PAGE}, from the top")
    chosen = parser.parse_args(arguments)
    differences = []
    for trajectory in chosen.trajectories:
        case = Case(model=chosen.model, trajectory=trajectory, sensors=chosen.sensors, seed=chosen.seed)
        differences.append(compare(case, lock_step=not chosen.real_time))
    tables = [comparison_table(differences)]
    if chosen.real_time:
        tables.append(timing_table(differences))
    console = output_console()
    for table in tables:
        console.print(table.rich())
    if chosen.page:
        _write(tables, "real-time" if chosen.real_time else "lock-step", chosen)


def _write(tables: Sequence[Table], marker: str, chosen: argparse.Namespace) -> None:
    """Put the tables between the markers of that name, with what they were measured on."""
    parts = ["\n".join(table.markdown().splitlines()[2:]) for table in tables]
    facts = f"Model {chosen.model}, seed {chosen.seed}, sensors {chosen.sensors}; {measured_on()}"
    text = "\n\n".join([*parts, facts])
    PAGE.write_text(insert(PAGE.read_text(encoding="utf-8"), text, marker), encoding="utf-8")


if __name__ == "__main__":
    main()
