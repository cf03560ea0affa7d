"""Drives of the simulated robot as the records that the identification takes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.trajectories import load_segments
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands, step_commands

StepKind = Literal["wheels", "v", "omega"]
STEP_KINDS: tuple[StepKind, ...] = ("wheels", "v", "omega")

_SEEDS_EACH = 1000


class RobotLogs:
    """The drives of one repetition; each has a seed of its own, in the order in which they are asked for.

    Poses of the records are true ones: the papers hold predictions against a localisation, whose own error is small
    beside theirs.

    Parameters
    ----------
    repetition
        Number from which the seeds are counted.
    """

    def __init__(self, repetition: int) -> None:
        self._seeds: Iterator[int] = iter(range(_SEEDS_EACH * repetition, _SEEDS_EACH * (repetition + 1)))

    def steps(self, kind: StepKind) -> list[Record]:
        """The steps of "wheels", "v" or "omega"; see `sim.plants.open_loop.step_commands`."""
        return self._driven(f"step of {kind}", step_commands(kind))

    def free(self, drives: int, duration: float) -> list[Record]:
        """Free drives of `duration` [s] each: smoothed random set-points."""
        return [
            record_of(f"free drive, seed {seed}", seed, random_commands(seed, duration=duration))
            for seed in (next(self._seeds) for _ in range(drives))
        ]

    def trajectory(self, name: str) -> Record:
        """A trajectory's commands in open loop, from rest at the origin."""
        return self._driven(name, [trajectory_commands(name)])[0]

    def _driven(self, name: str, commands: Iterable[FloatArray]) -> list[Record]:
        return [record_of(name, next(self._seeds), rows) for rows in commands]


def trajectory_commands(name: str) -> FloatArray:
    """(K, 2) v [m/s], omega [rad/s] of a trajectory's segments, one row per sample, without slopes between them."""
    segments, dt = load_segments(name), load_robot().sample_time
    ends = np.cumsum([segment.duration for segment in segments])
    rows = np.searchsorted(ends, dt * np.arange(round(ends[-1] / dt)), side="right")
    return np.array([(segment.v, segment.omega) for segment in segments])[np.minimum(rows, len(segments) - 1)]


def record_of(name: str, seed: int, commands: FloatArray) -> Record:
    """Drive the simulated robot on the default surface and record it."""
    log = drive_open_loop(make_plant("mujoco", seed=seed), commands)
    return Record(
        name,
        0.0,
        load_robot().sample_time,
        log.command,
        twist=log.wheel_twist,
        yaw_rate=log.yaw_rate,
        pose=log.true_pose,
        wheel_speeds=log.wheel_speeds,
    )
