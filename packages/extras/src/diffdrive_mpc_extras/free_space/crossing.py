"""Moving discs that cross the path of the robot, and the place to wait for them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.guide import Guide
from diffdrive_mpc_extras.free_space.pieces import Pieces, PlacedFootprint, min_gaps

_STRIDE = 2  # distance between the checked nodes of the path [nodes]
_STEP = 0.15  # interval at which a place to wait is checked against the discs [s]


class Crossing(NamedTuple):
    """Temporary end of the path.

    Attributes
    ----------
    ends
        Arc length of the place to wait [m].
    piece
        Index of the disc for which the robot waits.
    """

    ends: float
    piece: int


def crossing(
    guide: Guide,
    footprint: PlacedFootprint,
    moving: Pieces,
    settings: FreeSpace,
    motion: tuple[float, float, float],
    age: float,
    required_gap: float,
) -> Crossing | None:
    """Find the place to wait for moving discs; return None if the path is free.

    The robot is assumed to follow the path and to accelerate to the speed of the reference. If a disc then comes nearer
    than `required_gap` plus the uncertainty of its position, the robot waits at the last earlier place that no disc
    approaches.

    Parameters
    ----------
    guide, footprint, moving, settings
        Path, footprint of the robot, moving discs, and configuration.
    motion
        Present arc length [m], speed of the robot and speed of the reference [m/s].
    age
        Age of the positions of the discs [s].
    required_gap
        Minimum gap to a disc [m].
    """
    arc, v, cruise_speed = motion
    spacing = guide.table.spacing
    start = guide.node(arc)
    end = min(start + int(settings.look_ahead / spacing), len(guide.table) - 1)
    nodes: NDArray[np.intp] = np.arange(start, end + 1, _STRIDE)
    poses = guide.poses(nodes)
    times = _arrivals(
        np.maximum(nodes * spacing - arc, 0.0), v, max(cruise_speed, float(guide.table.speed[start]), 0.05), settings
    )
    within = times <= settings.disc_horizon
    nodes, poses, times = nodes[within], poses[within], times[within]
    doubt = settings.disc_doubt * times
    max_gap = required_gap + settings.comfort + settings.disc_doubt * settings.disc_horizon
    gaps, pieces = min_gaps(footprint, moving, poses, age + times, max_gap)
    conflicts = np.flatnonzero((gaps < required_gap + doubt) & (pieces >= 0))
    if conflicts.size == 0:
        return None
    first = int(conflicts[0])
    # No disc may approach a place to wait after the arrival of the robot.
    instants = np.arange(0.0, settings.disc_horizon + 1e-9, _STEP)
    count = first + 1
    waiting_poses = np.repeat(poses[:count], len(instants), axis=0)
    wait_times = np.tile(instants, count)
    passing, _ = min_gaps(footprint, moving, waiting_poses, age + wait_times, max_gap)
    is_waiting = wait_times >= np.repeat(times[:count], len(instants))
    places = np.zeros(0, dtype=int)
    # Prefer a place that stays free even if the motion of a disc differs from the reported velocity.
    for gap_limit in (required_gap + settings.disc_doubt * wait_times, np.full(wait_times.shape, required_gap)):
        safe = np.all(np.reshape((passing >= gap_limit) | ~is_waiting, (count, -1)), axis=1)
        if not places.size and first:
            places = np.flatnonzero(safe[:first])
    # Prefer a place before which the robot can stop.
    stopping = 0.5 * v * v / settings.deceleration
    reachable = [i for i in places.tolist() if nodes[i] * spacing - arc >= stopping - spacing] or places.tolist()
    place = nodes[max(reachable)] * spacing if reachable else arc
    return Crossing(float(place) if math.isfinite(place) else arc, int(pieces[first]))


def _arrivals(distance: FloatArray, v: float, cruise_speed: float, settings: FreeSpace) -> FloatArray:
    """Compute the times (k,) at which the robot has covered each `distance` (k,) [m] while it accelerates from `v`."""
    a = settings.deceleration
    top = max(v, cruise_speed)
    ramp = (top * top - v * v) / (2.0 * a)
    ramp_time = (np.sqrt(v * v + 2.0 * a * np.minimum(distance, ramp)) - v) / a
    return np.asarray(ramp_time + np.maximum(distance - ramp, 0.0) / top)
