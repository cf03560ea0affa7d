"""Moving discs that cross the robot's path, and the place to wait for them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.guide import Guide
from diffdrive_mpc_extras.free_space.pieces import Pieces, PlacedFootprint, least_gaps

_STRIDE = 2  # nodes of the way that are checked
_STEP = 0.15  # between two instants at which a place to wait is compared with the discs [s]


class Crossing(NamedTuple):
    """Temporary end of the path.

    Attributes
    ----------
    ends
        Arc length of the place to wait [m].
    piece
        The disc that it waits for.
    """

    ends: float
    piece: int


def crossing(
    guide: Guide,
    footprint: PlacedFootprint,
    moving: Pieces,
    settings: FreeSpace,
    motion: tuple[float, float, float],
    since: float,
    keeps: float,
) -> Crossing | None:
    """Find the place to wait for moving discs; None if the path is free.

    The robot is assumed to continue on its way and to accelerate to the reference's speed. Where a disc would then come
    nearer than `keeps` plus the uncertainty of its speed, the robot waits at the last place before it that no disc
    passes.

    Parameters
    ----------
    guide, footprint, moving, settings
        The way, the robot, and the discs.
    motion
        Arc length now [m], the robot's speed, and that of the reference [m/s].
    since
        Age of the discs' positions [s].
    keeps
        Gap to keep [m].
    """
    arc, v, wanted = motion
    spacing = guide.table.spacing
    start = guide.node(arc)
    end = min(start + int(settings.look_ahead / spacing), len(guide.table) - 1)
    nodes: NDArray[np.intp] = np.arange(start, end + 1, _STRIDE)
    poses = guide.poses(nodes)
    times = _arrivals(
        np.maximum(nodes * spacing - arc, 0.0), v, max(wanted, float(guide.table.speed[start]), 0.05), settings
    )
    within = times <= settings.disc_horizon
    nodes, poses, times = nodes[within], poses[within], times[within]
    doubt = settings.disc_doubt * times
    enough = keeps + settings.comfort + settings.disc_doubt * settings.disc_horizon
    gaps, pieces = least_gaps(footprint, moving, poses, since + times, enough)
    meets = np.flatnonzero((gaps < keeps + doubt) & (pieces >= 0))
    if meets.size == 0:
        return None
    first = int(meets[0])
    # Condition of a place to wait: from the robot's arrival on no disc passes it.
    instants = np.arange(0.0, settings.disc_horizon + 1e-9, _STEP)
    count = first + 1
    stays = np.repeat(poses[:count], len(instants), axis=0)
    when = np.tile(instants, count)
    passing, _ = least_gaps(footprint, moving, stays, since + when, enough)
    late = when >= np.repeat(times[:count], len(instants))
    places = np.zeros(0, dtype=int)
    # Preferred is a place that no disc approaches even if its motion differs somewhat from the reported one.
    for wide in (keeps + settings.disc_doubt * when, np.full(when.shape, keeps)):
        safe = np.all(np.reshape((passing >= wide) | ~late, (count, -1)), axis=1)
        if not places.size and first:
            places = np.flatnonzero(safe[:first])
    # One that it can stop at in time.
    stopping = 0.5 * v * v / settings.deceleration
    reachable = [i for i in places.tolist() if nodes[i] * spacing - arc >= stopping - spacing] or places.tolist()
    place = nodes[max(reachable)] * spacing if reachable else arc
    return Crossing(float(place) if math.isfinite(place) else arc, int(pieces[first]))


def _arrivals(distance: FloatArray, v: float, wanted: float, settings: FreeSpace) -> FloatArray:
    """Compute the times (k,) at which an accelerating robot has covered each `distance` (k,) [m]."""
    a = settings.deceleration
    top = max(v, wanted)
    gaining = (top * top - v * v) / (2.0 * a)
    near = (np.sqrt(v * v + 2.0 * a * np.minimum(distance, gaining)) - v) / a
    return np.asarray(near + np.maximum(distance - gaining, 0.0) / top)
