"""The runs of a map, and what they came to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.app.proof.proof_file import Map
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.engine import Driven
from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True)
class Drawn:
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


def drawn_map(name: str, of: Map, runs: Sequence[Definition], driven: Sequence[Driven]) -> Drawn:
    """What came of the runs of `map_runs`."""
    by_run = {one.definition: one for one in driven}
    shape = (of.y.steps, of.x.steps)

    def grid(column: str) -> FloatArray:
        return np.array([by_run[run].number(column) for run in runs]).reshape(shape)

    return Drawn(name, of, grid("position_rmse_m"), grid("lateral_max_m"), grid("completed"))
