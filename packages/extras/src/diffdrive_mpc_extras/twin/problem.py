"""Output errors of the plant and their slopes, with the priors as further rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.statistics import effective_samples
from diffdrive_mpc.sim.plants.plant import RobotLostError
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot
from diffdrive_mpc_extras.twin.free_run import FreeMotion, LogStretch, drive, readings
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import Space

Task = Callable[[], list[FreeMotion] | None]
Together = Callable[[Sequence[Task]], list[list[FreeMotion] | None]]
"""Calls all tasks, in one process or several, and gives their results in order."""
_LOST = 10.0
"""Error of a robot that tips over, in deviations."""


def one_by_one(tasks: Sequence[Task]) -> list[list[FreeMotion] | None]:
    """Run the tasks in this process."""
    return [task() for task in tasks]


def _driven(robot: SimulatedRobot, stretches: Sequence[LogStretch]) -> list[FreeMotion] | None:
    try:
        return drive(robot, stretches)
    except RobotLostError:
        return None


@dataclass
class TwinProblem:
    """Least squares: readings over their noise, parameters over their priors.

    Attributes
    ----------
    space
        The parameters.
    stretches
        Stretches of the log that are fitted.
    together
        Function that runs several drives.
    on_drive
        Called after each set of parameters that was driven.
    weight
        (p,) one over the noise of a reading of each sensor; a reading of correlated noise counts for less than one.
    """

    space: Space
    stretches: Sequence[LogStretch]
    together: Together = one_by_one
    on_drive: Callable[[], None] = lambda: None
    weight: FloatArray | None = None

    def motions(self, z: FloatArray) -> list[FreeMotion] | None:
        """Simulate the plant at deviations `z` (q,); None if it fails."""
        motions = _driven(self.space.robot(self.space.values(z)), self.stretches)
        self.on_drive()
        return motions

    def errors(self, z: FloatArray, motions: Sequence[FreeMotion] | None) -> list[FloatArray]:
        """Compute simulated less measured readings (K, p) of each stretch, NaN without reading."""
        values = self.space.values(z)
        if motions is None:
            assert self.weight is not None
            lost = _LOST / self.weight
            return [np.where(stretch.experiment.counts, lost, np.nan) for stretch in self.stretches]
        return [
            np.where(
                stretch.experiment.counts,
                readings(motion, stretch.experiment, values) - stretch.experiment.outputs,
                np.nan,
            )
            for stretch, motion in zip(self.stretches, motions, strict=True)
        ]

    def weigh(self, errors: Sequence[FloatArray]) -> None:
        """Take the noise from errors: their size, times the root of how many readings are worth one."""
        every = np.concatenate(errors)
        used = np.isfinite(every).sum(axis=0)
        size = np.sqrt(np.nanmean(every**2, axis=0))
        self.weight = 1.0 / np.maximum(size * np.sqrt(used / effective_samples(errors)), 1e-9)

    def rows(self, errors: Sequence[FloatArray]) -> FloatArray:
        """Stack the weighted errors (n,) of all readings that count."""
        assert self.weight is not None
        every = np.concatenate(errors) * self.weight
        return np.asarray(every[np.isfinite(every)])

    def drives(self, free: Sequence[int]) -> list[bool]:
        """Return True for each parameter of `free` that needs another drive; the log's sensors need none."""
        return [self.space.names[i] not in twin_settings().sensors for i in free]

    def slopes(self, z: FloatArray, free: Sequence[int], motions_at_z: Sequence[FreeMotion]) -> FloatArray:
        """Compute derivatives (n, len(free)) of `rows` by one-sided differences; those of the sensors need no drive."""
        _, high = self.space.bounds
        steps = self.space.steps
        moved = []
        for i in free:
            varied = z.copy()
            varied[i] += steps[i] if z[i] + steps[i] < high[i] else -steps[i]
            moved.append(varied)
        driven = self.drives(free)
        tasks = [
            partial(_driven, self.space.robot(self.space.values(varied)), self.stretches)
            for varied, new in zip(moved, driven, strict=True)
            if new
        ]
        results = iter(self.together(tasks))
        base = self.rows(self.errors(z, motions_at_z))
        columns = []
        for i, varied, new in zip(free, moved, driven, strict=True):
            motions = next(results) if new else list(motions_at_z)
            if new:
                self.on_drive()
            away = base if motions is None else self.rows(self.errors(varied, motions))
            columns.append((away - base) / (varied[i] - z[i]))
        return np.column_stack(columns)

    def blocks(self) -> list[NDArray[np.int64]]:
        """Return the indices of `rows` by blocks of a few seconds."""
        span = max(1, round(twin_settings().block / self.stretches[0].experiment.dt))
        labels: list[NDArray[np.int64]] = []
        next_label = 0
        for stretch in self.stretches:
            count = stretch.experiment.samples
            label = next_label + np.arange(count) // span
            next_label = int(label[-1]) + 1
            labels.append(
                np.repeat(label[:, None], stretch.experiment.counts.shape[1], axis=1)[stretch.experiment.counts]
            )
        every = np.concatenate(labels)
        return [np.flatnonzero(every == label) for label in range(next_label)]
