"""A stretch of the reference around its present time, sampled, and where the robot is beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.config.thresholds import STANDING

# Paths meet themselves, so a place further along the path counts as further away: by this share of the path between,
# and by this for the time between [m/s].
_PATH_AS_DISTANCE = 0.5
_TIME_AS_DISTANCE = 0.02


@dataclass(frozen=True)
class PathWindow:
    """The reference at n even times.

    Attributes
    ----------
    times
        (n,) reference time [s].
    pose
        (n, 3) x, y [m], theta [rad].
    twist
        (n, 2) [m/s, rad/s].
    arc_length
        (n,) [m].
    travel
        (n,) 1 where the reference goes forwards, -1 where backwards; where it stands, as in the motion to come.
    """

    times: FloatArray
    pose: FloatArray
    twist: FloatArray
    arc_length: FloatArray
    travel: FloatArray

    @classmethod
    def around(cls, reference: Reference, time: float, span: float, step: float) -> PathWindow:
        """Sample from `span` [s] before to `span` after `time` [s], within the reference, about every `step` [s]."""
        first = min(max(0.0, time - span), reference.duration)
        last = max(min(reference.duration, time + span), first)
        times = np.linspace(first, last, max(2, math.ceil((last - first) / step) + 1))
        sample = reference.sample(times)
        return cls(times, sample.pose, sample.twist, sample.arc_length, _travel(sample.twist[:, 0]))

    def nearest(self, pose: FloatArray, time: float) -> int:
        """Index of the sample nearest to the position of `pose` (3,), those near `time` [s] being preferred."""
        offset = self.pose[:, :2] - pose[:2]
        path = np.abs(self.arc_length - np.interp(time, self.times, self.arc_length))
        away = np.hypot(offset[:, 0], offset[:, 1])
        return int(np.argmin(away + _PATH_AS_DISTANCE * path + _TIME_AS_DISTANCE * np.abs(self.times - time)))

    def beside(self, pose: FloatArray, index: int) -> tuple[float, float]:
        """Position of `pose` (3,) along and across the heading of sample `index` [m]; left is positive."""
        x, y, theta = self.pose[index].tolist()
        return in_path(pose[0] - x, pose[1] - y, theta)


def in_path(dx: float, dy: float, theta: float) -> tuple[float, float]:
    """A displacement [m] in parts along and across the heading `theta` [rad], positive to its left."""
    c, s = math.cos(theta), math.sin(theta)
    return c * dx + s * dy, c * dy - s * dx


def _travel(v: FloatArray) -> FloatArray:
    """Sign of `v` (n,), filled in from the samples after, else before, where it is about zero."""
    moving = np.flatnonzero(np.abs(v) > STANDING)
    if not moving.size:
        return np.ones_like(v)
    at = np.minimum(np.searchsorted(moving, np.arange(v.size)), moving.size - 1)
    return np.asarray(np.sign(v[moving[at]]))
