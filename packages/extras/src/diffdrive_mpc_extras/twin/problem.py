"""Least-squares problem of a fit: output errors of the plant and their derivatives."""

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
from diffdrive_mpc_extras.twin.free_run import FreeMotion, LogStretch, drive, sensor_readings
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import Space

Task = Callable[[], list[FreeMotion] | None]
TaskRunner = Callable[[Sequence[Task]], list[list[FreeMotion] | None]]
"""Function that runs tasks in one or several processes and returns their results in order."""
_FAILURE_ERROR = 10.0
"""Error of all readings if the robot tips over or diverges, in standard deviations."""


def run_sequentially(tasks: Sequence[Task]) -> list[list[FreeMotion] | None]:
    """Run the tasks in this process."""
    return [task() for task in tasks]


def _try_drive(robot: SimulatedRobot, stretches: Sequence[LogStretch]) -> list[FreeMotion] | None:
    """Return the result of `drive`; None if the robot tips over or diverges."""
    try:
        return drive(robot, stretches)
    except RobotLostError:
        return None


@dataclass
class TwinProblem:
    """Least-squares problem with the errors of readings over their noise.

    Attributes
    ----------
    space
        Space of the parameters.
    stretches
        Fitted stretches of the log.
    run_tasks
        Function that runs several simulations.
    on_drive
        Called after each simulation of the stretches.
    weight
        (p,) weight of the readings of each sensor: the inverse of their noise, reduced for correlated noise.
    """

    space: Space
    stretches: Sequence[LogStretch]
    run_tasks: TaskRunner = run_sequentially
    on_drive: Callable[[], None] = lambda: None
    weight: FloatArray | None = None

    def motions(self, z: FloatArray) -> list[FreeMotion] | None:
        """Simulate the plant at deviations `z` (q,); None if it tips over or diverges."""
        motions = _try_drive(self.space.robot(self.space.values(z)), self.stretches)
        self.on_drive()
        return motions

    def errors(self, z: FloatArray, motions: Sequence[FreeMotion] | None) -> list[FloatArray]:
        """Compute simulated minus measured readings (K, p) of each stretch; NaN without a reading."""
        values = self.space.values(z)
        if motions is None:
            assert self.weight is not None
            failure_errors = _FAILURE_ERROR / self.weight
            return [np.where(stretch.experiment.counts, failure_errors, np.nan) for stretch in self.stretches]
        return [
            np.where(
                stretch.experiment.counts,
                sensor_readings(motion, stretch.experiment, values) - stretch.experiment.outputs,
                np.nan,
            )
            for stretch, motion in zip(self.stretches, motions, strict=True)
        ]

    def set_weights(self, errors: Sequence[FloatArray]) -> None:
        """Set the weights from the RMS of errors (K, p) and their number of effective samples."""
        stacked = np.concatenate(errors)
        count = np.isfinite(stacked).sum(axis=0)
        rms = np.sqrt(np.nanmean(stacked**2, axis=0))
        self.weight = 1.0 / np.maximum(rms * np.sqrt(count / effective_samples(errors)), 1e-9)

    def rows(self, errors: Sequence[FloatArray]) -> FloatArray:
        """Stack the weighted errors (n,) of all readings."""
        assert self.weight is not None
        weighted = np.concatenate(errors) * self.weight
        return np.asarray(weighted[np.isfinite(weighted)])

    def drives(self, free: Sequence[int]) -> list[bool]:
        """Return True for each parameter of `free` that needs a simulation; parameters of sensors do not."""
        return [self.space.names[i] not in twin_settings().sensors for i in free]

    def slopes(self, z: FloatArray, free: Sequence[int], motions_at_z: Sequence[FreeMotion]) -> FloatArray:
        """Compute derivatives (n, len(free)) of `rows` by one-sided finite differences."""
        _, high = self.space.bounds
        steps = self.space.steps
        points = []
        for i in free:
            point = z.copy()
            point[i] += steps[i] if z[i] + steps[i] < high[i] else -steps[i]
            points.append(point)
        needs_drive = self.drives(free)
        tasks = [
            partial(_try_drive, self.space.robot(self.space.values(point)), self.stretches)
            for point, is_needed in zip(points, needs_drive, strict=True)
            if is_needed
        ]
        results = iter(self.run_tasks(tasks))
        base = self.rows(self.errors(z, motions_at_z))
        columns = []
        for i, point, is_needed in zip(free, points, needs_drive, strict=True):
            motions = next(results) if is_needed else list(motions_at_z)
            if is_needed:
                self.on_drive()
            rows = base if motions is None else self.rows(self.errors(point, motions))
            columns.append((rows - base) / (point[i] - z[i]))
        return np.column_stack(columns)

    def blocks(self) -> list[NDArray[np.int64]]:
        """Return the indices of `rows` in each block of a few seconds."""
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
        all_labels = np.concatenate(labels)
        return [np.flatnonzero(all_labels == label) for label in range(next_label)]
