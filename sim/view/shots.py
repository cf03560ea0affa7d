"""What is to be painted: where everything is in each picture, and from where it is seen."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.body import Body

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
    body: Body
    surface: str
    camera: Camera
    size: tuple[int, int]

    def save(self, path: Path) -> None:
        """Write to a .npz file."""
        rest = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in _ARRAYS}
        words = json.dumps({**rest, "body": asdict(self.body)})
        np.savez(path, words=np.array(words), **{name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def load(cls, path: Path) -> Shots:
        """Read what `save` wrote."""
        with np.load(path) as stored:
            words = json.loads(str(stored["words"]))
            arrays = {name: stored[name] for name in _ARRAYS}
        words["body"] = Body(**{**words["body"], "size": tuple(words["body"]["size"])})
        words["camera"], words["size"] = Camera(words["camera"]), tuple(words["size"])
        return cls(**arrays, **words)
