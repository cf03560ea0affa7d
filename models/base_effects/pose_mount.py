"""Where the pose sensor sits, as against the point that the robot turns about and the way it drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray


class PoseMount(StrictModel):
    """Lever arm and heading of a pose sensor on the robot, in the sensor's own axes.

    A velocity model describes the centre of rotation. Poses of another point, taken for it, look like side-slip.
    """

    ahead: float = Field(default=0.0, description="sensor ahead of the centre of rotation [m]")
    left: float = Field(default=0.0, description="sensor left of the centre of rotation [m]")
    heading: float = Field(
        default=0.0, ge=-np.pi, le=np.pi, description="direction of travel less sensor's heading [rad]"
    )

    def centre(self, sensor: ArrayLike) -> FloatArray:
        """Poses (..., 3) of the centre of rotation for poses (..., 3) of the sensor: x, y [m], theta [rad]."""
        pose = np.asarray(sensor, dtype=float)
        theta = pose[..., 2]
        return self._moved(pose, theta, -1.0, theta + self.heading)

    def sensor(self, centre: ArrayLike) -> FloatArray:
        """Poses (..., 3) of the sensor for poses (..., 3) of the centre: the exact inverse of `centre`."""
        pose = np.asarray(centre, dtype=float)
        theta = pose[..., 2] - self.heading
        return self._moved(pose, theta, 1.0, theta)

    def _moved(self, pose: FloatArray, axes: FloatArray, sign: float, theta: FloatArray) -> FloatArray:
        """`pose` shifted by the lever arm along the sensor's `axes` [rad], with heading `theta`."""
        dx = np.cos(axes) * self.ahead - np.sin(axes) * self.left
        dy = np.sin(axes) * self.ahead + np.cos(axes) * self.left
        return np.stack([pose[..., 0] + sign * dx, pose[..., 1] + sign * dy, theta], axis=-1)
