"""What is to be painted: where everything is in each picture, and from where it is seen."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.body import BodyShape

_ARRAYS = ("time", "poses", "wheel_angles", "passed", "plans", "way", "reference")


class Camera(StrEnum):
    """From where the robot is seen."""

    CHASE = "chase"
    FIXED = "fixed"


@dataclass(frozen=True)
class Shots:
    """A sequence of m pictures of one drive.

    Attributes
    ----------
    time
        (m,) of each picture [s].
    poses, wheel_angles
        (m, 3) x, y [m], theta [rad, unwrapped] and (m, 4) [rad] of the robot.
    way, passed
        (n, 2) where it went in the whole drive [m], and (m,) how many of these points it has passed.
    plans
        (m, p, 2) points of its plan [m], NaN where it has none; p may be 0.
    reference, band
        (k, 2) the path [m], k may be 0, and half the width of the strip along it [m].
    body, surface
        Lengths of the robot, name of the floor.
    camera, size
        From where, and width and height [pixels].
    """

    time: FloatArray
    poses: FloatArray
    wheel_angles: FloatArray
    passed: NDArray[np.intp]
    plans: FloatArray
    way: FloatArray
    reference: FloatArray
    band: float
    body: BodyShape
    surface: str
    camera: Camera
    size: tuple[int, int]

    def save(self, path: Path) -> None:
        """Write to a .npz file."""
        rest = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _ARRAYS}
        words = json.dumps({**rest, "body": asdict(self.body)})
        np.savez(path, words=np.array(words), **{name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def load(cls, path: Path) -> Shots:
        """Read what `save` wrote."""
        with np.load(path) as stored:
            words = json.loads(str(stored["words"]))
            arrays = {name: stored[name] for name in _ARRAYS}
        words["body"] = BodyShape(**{**words["body"], "size": tuple(words["body"]["size"])})
        words["camera"], words["size"] = Camera(words["camera"]), tuple(words["size"])
        return cls(**arrays, **words)


# From where the robot is looked at, in the terms of MuJoCo's free camera.


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


def overview(points: FloatArray, room: float, aspect: float) -> FloatArray:
    """All of `seen` (n, 2) [m] in one picture `aspect` times as wide as high, with `room` [m] around; x to the right.

    Returns
    -------
    FloatArray
        (6,) as a row of `chase`.
    """
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    wide, deep = (high - low + 2.0 * room).tolist()
    needed = max(deep * math.sin(math.radians(-_OVER)), wide / aspect)
    distance = _NEARER * 0.5 * needed / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    return np.array([*(0.5 * (low + high)), 0.0, distance, 90.0, _OVER])
