"""The largest value of a factor that still holds, by bisection with repeated seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.proof.proof_file import BoundarySearch, Map

Drive = Callable[[list[Definition]], list[CampaignRun]]
"""Drives runs and gives them in order; each is another one."""


@dataclass
class Boundary:
    """Where a factor stops to hold.

    Attributes
    ----------
    factor
        Its name.
    search
        What was asked.
    held
        The value nearest to the boundary that held with every seed; None where not even the first did.
    failed
        The nearest that did not; None where all did.
    values
        Every value that was tried, and with how many seeds it held.
    """

    factor: str
    search: BoundarySearch
    held: float | None = None
    failed: float | None = None
    values: dict[float, int] = field(default_factory=dict)

    @property
    def next_value(self) -> float | None:
        """What to try now; None when the boundary is known well enough."""
        if self.held is None:
            return self.search.holds if self.failed is None else None
        if self.failed is None:
            return self.search.beyond if self.held != self.search.beyond else None
        if abs(self.failed - self.held) <= self.search.within:
            return None
        middle = float(f"{0.5 * (self.held + self.failed):.9g}")
        return None if middle in self.values else middle  # no number of nine digits lies between

    def take(self, value: float, held: int, seeds: int) -> None:
        """Take what came of a value."""
        self.values[value] = held
        if held == seeds:
            self.held = value
        else:
            self.failed = value


def holds(driven: CampaignRun, band: float) -> bool:
    """Whether a run came to its end and was never further than `band` [m] from its path."""
    return driven.row["completed"] is True and driven.number("lateral_max_m") <= band


def find_boundaries(
    searches: Mapping[str, BoundarySearch], probe: Definition, seeds: Sequence[int], drive: Drive, band: float
) -> list[Boundary]:
    """Search for the boundaries of several factors at once, each by itself from `probe`; `band` [m] as in `holds`.

    Between what held and what did not everything is taken to be monotone; what lies beyond is not looked at.
    """
    boundaries = [Boundary(factor, search) for factor, search in searches.items()]
    while queries := [(boundary, value) for boundary in boundaries if (value := boundary.next_value) is not None]:
        runs = [_with(probe, boundary.factor, value).with_seed(seed) for boundary, value in queries for seed in seeds]
        driven = {one.definition: one for one in drive(runs)}
        for index, (boundary, value) in enumerate(queries):
            mine = runs[index * len(seeds) : (index + 1) * len(seeds)]
            boundary.take(value, sum(holds(driven[run], band) for run in mine), len(seeds))
    return boundaries


def _with(probe: Definition, factor: str, value: Value) -> Definition:
    return probe.changed({factor: value})


# The runs of a map, and what they came to.


@dataclass(frozen=True)
class DrivenMap:
    """A map that was driven: (rows, columns), a row for each value of y, a column for each of x.

    Attributes
    ----------
    name, of
        Its name and its axes.
    error
        Position RMSE [m]; NaN where nothing could be driven.
    lateral
        Largest |lateral| [m].
    completed
        1 where the run came to its end, else 0.
    """

    name: str
    of: Map
    error: FloatArray
    lateral: FloatArray
    completed: FloatArray


def map_runs(of: Map, probe: Definition, seed: int) -> list[Definition]:
    """The runs of a map, row by row."""
    return [probe.changed({of.x.factor: x, of.y.factor: y}).with_seed(seed) for y in of.y.values for x in of.x.values]


def drawn_map(name: str, of: Map, runs: Sequence[Definition], driven: Sequence[CampaignRun]) -> DrivenMap:
    """What came of the runs of `map_runs`."""
    by_run = {run.definition: run for run in driven}
    shape = (of.y.steps, of.x.steps)

    def grid(column: str) -> FloatArray:
        return np.array([by_run[run].number(column) for run in runs]).reshape(shape)

    return DrivenMap(name, of, grid("position_rmse_m"), grid("lateral_max_m"), grid("completed"))
