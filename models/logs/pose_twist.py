"""Twist of a robot from differences of poses along circular arcs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record

# Minimum span of a difference [s]: shorter spans have more noise; in longer spans the robot does not drive an arc.
_MIN_SPAN = 0.3


def with_twist_of_poses(records: Sequence[Record]) -> tuple[Record, ...]:
    """Return records with `twist` computed from the poses; records with fewer than two poses are unchanged.

    The robot is assumed to drive a circular arc between two poses, so the chord and the change of heading give the mean
    v and omega. Each mean is assigned to the sample halfway between the poses, which adds no delay. Only these samples
    are marked as fresh.
    """
    return tuple(_with_twist(record) for record in records)


def _with_twist(record: Record) -> Record:
    pose, fresh = record.pose, record.fresh_pose
    if pose is None or fresh is None or np.count_nonzero(fresh) < 2:
        return record
    rows = np.flatnonzero(fresh)
    steps = np.diff(rows)
    # A sample halfway between two poses exists only if they are an even number of samples apart.
    min_span = max(2, int(np.ceil(_MIN_SPAN / record.dt - 1e-9)))
    max_span = 2 * max(min_span, 2 * int(np.median(steps)))
    twist, is_fresh = np.full((len(pose), 2), np.nan), np.zeros(len(pose), dtype=bool)
    used_spans = []
    for index, first in enumerate(rows):
        spans = rows[index + 1 :][: max_span + 1] - first
        usable = spans[(spans >= min_span) & (spans % 2 == 0) & (spans <= max_span)]
        if len(usable):
            span = int(usable[0])
            used_spans.append(span)
            middle = first + span // 2
            twist[middle], is_fresh[middle] = _mean_twist(pose[first], pose[first + span], span * record.dt), True
    known = np.flatnonzero(is_fresh)
    if len(known) < 2:
        return record
    inside = np.arange(known[0], known[-1] + 1)
    for column in twist.T:
        column[inside] = np.interp(inside, known, column[known])
    # Jittered poses have several spans; the fit assumes the usual one.
    return replace(record, twist=twist, fresh_twist=is_fresh, twist_span=2 * round(0.5 * float(np.median(used_spans))))


def _mean_twist(before: FloatArray, after: FloatArray, duration: float) -> tuple[float, float]:
    """Return the mean v [m/s] and omega [rad/s] of the arc between two poses (x, y, theta)."""
    dx, dy, turn = after - before
    middle = before[2] + 0.5 * turn
    # The chord of an arc is parallel to the mean heading; the lateral component is slip or noise.
    chord = np.cos(middle) * dx + np.sin(middle) * dy
    # The chord of an arc is its length times sin(turn / 2) / (turn / 2).
    return chord / np.sinc(0.5 * turn / np.pi) / duration, turn / duration
