"""Twist of a robot of which only poses are known, by differences over arcs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

# A difference spans at least this long [s]: shorter ones hold more noise, longer ones blur the answer to a command.
_SPAN = 0.1


def with_twist_of_poses(records: Sequence[Record]) -> tuple[Record, ...]:
    """Return records whose `twist` follows from their poses; those without two poses are as they were.

    Between two poses the robot drives an arc, so chord and change of heading give the mean of v and omega. Each mean
    stands in the row halfway, which adds no delay. A reading is fresh in such rows only.
    """
    return tuple(_with_twist(record) for record in records)


def _with_twist(record: Record) -> Record:
    pose, fresh = record.pose, record.fresh_pose
    if pose is None or fresh is None or np.count_nonzero(fresh) < 2:
        return record
    rows = np.flatnonzero(fresh)
    steps = np.diff(rows)
    # Halfway between two poses there is a row only if their distance is even.
    least = max(2, int(np.ceil(_SPAN / record.dt - 1e-9)))
    longest = 2 * max(least, 2 * int(np.median(steps)))
    twist, heard = np.full((len(pose), 2), np.nan), np.zeros(len(pose), dtype=bool)
    for place, first in enumerate(rows):
        later = rows[place + 1 :][: longest + 1] - first
        fitting = later[(later >= least) & (later % 2 == 0) & (later <= longest)]
        if len(fitting):
            span = int(fitting[0])
            middle = first + span // 2
            twist[middle], heard[middle] = _mean_twist(pose[first], pose[first + span], span * record.dt), True
    known = np.flatnonzero(heard)
    if len(known) < 2:
        return record
    inside = np.arange(known[0], known[-1] + 1)
    for column in twist.T:
        column[inside] = np.interp(inside, known, column[known])
    return replace(record, twist=twist, fresh_twist=heard)


def _mean_twist(before: FloatArray, after: FloatArray, duration: float) -> tuple[float, float]:
    """Return the mean v [m/s] and omega [rad/s] of the arc between two poses (x, y, theta)."""
    dx, dy, turn = after - before
    middle = before[2] + 0.5 * turn
    chord = np.cos(middle) * dx + np.sin(middle) * dy
    return chord / np.sinc(0.5 * turn / np.pi) / duration, turn / duration
