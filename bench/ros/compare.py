"""The drive over DDS beside the simulation in one process, with the same seed.

Run as ``python -m bench.ros.compare [--real-time] [--model MODEL] [--seed SEED] [TRAJECTORY ...]``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.case import Case, build
from bench.console import output_console
from bench.ros.loop_timing import LoopTiming, loop_timing
from bench.ros.recorded_drive import read_drive
from bench.ros.two_processes import drive_over_dds
from bench.table import Column, Table
from sim import Run, simulate

TRAJECTORIES = ("circle", "s")
COMPARED = ("position_rmse_m", "lateral_rmse_m", "heading_rmse_rad", "position_max_m")
"""Statistics that are set side by side."""


@dataclass(frozen=True)
class Comparison:
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


def compare(case: Case, *, lock_step: bool = True, timeout: float = 300.0) -> Comparison:
    """Drive `case` over DDS and in one process.

    Parameters
    ----------
    case
        Of the controller "mpc".
    lock_step
        Whether clock and commands take turns over DDS; otherwise in real time.
    timeout
        Longest time that the drive over DDS may take [s].

    Raises
    ------
    bench.ros.two_processes.DriveFailedError
        If a process fails or takes too long.
    models.checked_yaml.ConfigError
        If a name or a file cannot be used, or the drive is not complete.
    """
    controller, plant, reference = build(case)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "drive"
        drive_over_dds(case, reference.duration, bag, lock_step=lock_step, timeout=timeout)
        over_dds = read_drive(bag, reference, plant.sample_time)
        timing = loop_timing(bag, plant.sample_time)
    return Comparison(case, over_dds, simulate(controller, plant, reference), timing)
