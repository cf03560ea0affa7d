"""From where the robot is looked at, in the terms of MuJoCo's free camera."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray

FIELD_OF_VIEW = 40.0
"""Vertical [degrees]."""
_SWING_TIME = 0.6  # [s], with which the camera behind the robot follows a turn
_BEHIND, _OVER = -40.0, -48.0  # [degrees], elevations
_ASIDE = 32.0  # [degrees], the camera behind the robot stands beside its track, so that the wheels are seen
_DISTANCE, _AHEAD = 5.2, 0.8  # lengths of the robot: of the camera from what it looks at, and of that from the robot
_NEARER = 1.2  # what is near looks larger: so much more room than its middle needs


def chase(time: FloatArray, poses: FloatArray, length: float) -> FloatArray:
    """Behind a robot of this length [m] at `poses` (m, 3) x, y [m], theta [rad], swinging softly with its turns.

    Returns
    -------
    FloatArray
        (m, 6) point looked at [m], distance [m], azimuth and elevation [degrees].
    """
    heading = np.unwrap(poses[:, 2])
    for k in range(1, len(heading)):
        share = 1.0 - math.exp(-(time[k] - time[k - 1]) / _SWING_TIME)
        heading[k] = heading[k - 1] + share * (heading[k] - heading[k - 1])
    places = poses[:, :2] + _AHEAD * length * np.column_stack([np.cos(heading), np.sin(heading)])
    aims = np.column_stack([places, np.zeros((len(heading), 4))])
    aims[:, 3], aims[:, 4], aims[:, 5] = _DISTANCE * length, np.degrees(heading) + _ASIDE, _BEHIND
    return aims


def overview(seen: FloatArray, room: float, aspect: float) -> FloatArray:
    """All of `seen` (n, 2) [m] in one picture `aspect` times as wide as high, with `room` [m] around; x to the right.

    Returns
    -------
    FloatArray
        (6,) as a row of `chase`.
    """
    seen = seen[np.isfinite(seen).all(axis=1)]
    low, high = seen.min(axis=0), seen.max(axis=0)
    wide, deep = (high - low + 2.0 * room).tolist()
    needed = max(deep * math.sin(math.radians(-_OVER)), wide / aspect)
    distance = _NEARER * 0.5 * needed / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    return np.array([*(0.5 * (low + high)), 0.0, distance, 90.0, _OVER])
