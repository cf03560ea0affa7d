"""Trajectories of exact arcs, turns on the spot and pauses, with piecewise constant acceleration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.mpc.trajectories.native import TableTrajectory
from diffdrive_mpc.mpc.trajectories.timing import Phase


class PathStretch(NamedTuple):
    """Section of a path with a constant ratio of forward to yaw motion, and its timing."""

    forward: float
    """Distance per unit of progress [m], negative backwards; 0 for a turn on the spot or a pause."""
    turn: float
    """Angle per unit of progress [rad], positive to the left; 0 for a straight line or a pause."""
    length: float
    """Progress at the end of the section."""
    phases: Sequence[Phase]
    """Timing of the progress along the section."""


@dataclass(frozen=True, eq=False, repr=False)
class ArcTrajectory(TableTrajectory):
    """Trajectory of exact arcs, sampled in closed form; pose and twist are consistent up to rounding.

    Attributes
    ----------
    breaks
        (m,) start time of each phase [s]; the last phase is the rest at the end.
    table
        (10, m) with a column per phase: start time; x, y, theta and arc length at the start of its section; forward
        distance and turn per unit of progress; progress, its rate and half its acceleration at the start of the phase.
    """

    @classmethod
    def chain(cls, name: str, start: ArrayLike, stretches: Sequence[PathStretch]) -> ArcTrajectory:
        """Build the trajectory of consecutive `stretches` from the pose `start` (3,) [m, m, rad]."""
        forward, turn, length = np.array([stretch[:3] for stretch in stretches], dtype=float).reshape(-1, 3).T
        poses = chain_arcs(start, forward, turn, length).tolist()
        time, arc_length = 0.0, 0.0
        columns: list[list[float]] = []
        # `poses` has one more entry, the end of the last stretch.
        for stretch, pose in zip(stretches, poses, strict=False):
            for phase in stretch.phases:
                columns.append([time, *pose, arc_length, stretch.forward, stretch.turn, *phase[:2], phase[2] / 2])
                time += phase.duration
            arc_length += abs(stretch.forward) * stretch.length
        columns.append([time, *poses[-1], arc_length, 0.0, 0.0, 0.0, 0.0, 0.0])
        table = np.ascontiguousarray(np.transpose(columns))
        return cls(name, time, table[0].copy(), table)


def chain_arcs(start: ArrayLike, forward: FloatArray, turn: FloatArray, length: FloatArray) -> FloatArray:
    """Chain n arcs from the pose `start` (3,); return the poses (n + 1, 3) [m, m, rad] at the ends of the arcs.

    Per unit of `length` (n,), an arc drives `forward` (n,) metres and turns by `turn` (n,) radians.
    """
    start_pose = np.asarray(start, dtype=float)
    heading = np.cumsum(np.append(start_pose[2], turn * length))
    # The displacement of an arc does not depend on its start position, so all arcs are integrated from the origin.
    poses = np.zeros((len(length), 3))
    poses[:, 2] = heading[:-1]
    displacement = integrate_pose(poses, forward, turn, length)[:, :2]
    return np.column_stack([np.cumsum(np.vstack([start_pose[:2], displacement]), axis=0), heading])
