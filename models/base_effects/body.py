"""What a body makes of the motion of its wheels, and where a pose sensor sits on it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray


class YawRelaxation(StrictModel):
    """First-order relaxation over the angle through which the wheels turn, not over time.

    With the wheels' yaw rate omega (as it is once settled) and the strain z of the tyres, -1 to 1:

        z' = (omega - |omega| z) / angle,     yaw rate of the body = |omega| z = omega - angle z'.

    So the body's heading is that of the wheels less `angle` times z, and each reversal costs twice `angle`. It is
    Dahl's friction model ("A solid friction model", 1968) between the wheels' heading and the body's.
    """

    angle: float = Field(gt=0, description="turn of the wheels over which the tyres twist [rad of yaw]")

    def advance(self, strain: float, yaw_rate: float, dt: float) -> tuple[float, float]:
        """One sample under a constant yaw rate of the wheels, exactly.

        Parameters
        ----------
        strain
            z at the start, -1 to 1.
        yaw_rate
            Yaw rate of the wheels [rad/s].
        dt
            Sample time [s].

        Returns
        -------
        tuple
            z at the end, and the mean yaw rate of the body over the sample [rad/s].
        """
        side = float(np.sign(yaw_rate))
        end = side + (strain - side) * float(np.exp(-abs(yaw_rate) * dt / self.angle))
        return end, yaw_rate - self.angle * (end - strain) / dt

    def gain(self, strain: float, yaw_rate: float) -> float:
        """Yaw rate of the body over that of the wheels: 1 once settled, negative just after a reversal."""
        return strain * float(np.sign(yaw_rate))

    def follow(self, yaw_rates: ArrayLike, dt: float, strain: float) -> FloatArray:
        """Yaw rates (K,) of the body [rad/s] for those of the wheels (K,), straight lines between samples of `dt` [s].

        `strain` is z at the first sample; 0 for tyres without twist, the sign of the yaw rate for a settled turn.
        """
        rates = np.asarray(yaw_rates, dtype=float)
        if not len(rates):
            return rates
        mean = 0.5 * (rates[1:] + rates[:-1])
        turned = np.concatenate([[0.0], np.cumsum(np.abs(mean))]) * dt / self.angle
        moving = np.flatnonzero(mean)
        side = np.sign(mean[moving])
        # Between two reversals the strain decays towards its side with the angle turned.
        first = moving[np.flatnonzero(np.concatenate([[True], side[1:] != side[:-1]]))] if len(moving) else moving
        edges = np.concatenate([[0], first, [len(mean)]])
        sides = np.concatenate([[0.0], np.sign(mean[first])])
        begin = np.empty(len(sides))
        for run, (low, high) in enumerate(pairwise(edges)):
            begin[run] = strain
            strain = sides[run] + (strain - sides[run]) * float(np.exp(turned[low] - turned[high]))
        counts = np.diff(edges)
        towards, since = np.repeat(sides, counts), np.repeat(turned[edges[:-1]], counts)
        after = towards + (np.repeat(begin, counts) - towards) * np.exp(since - turned[1:])
        return np.asarray(np.abs(rates) * np.concatenate([begin[:1], after]))


class Veer(StrictModel):
    """Yaw rate in proportion to forward speed: omega = omega_wheels + yaw_per_metre v, wheels of unequal radius.

    Source: coefficient a31 of Ordonez et al., 2017 (their omega = w_c + a31 v_c + ...).
    """

    yaw_per_metre: float = Field(description="yaw for each metre driven forward, left positive [rad/m]")

    def body(self, wheels: ArrayLike) -> FloatArray:
        """Twists (..., 2) of the body for twists (..., 2) by the wheels."""
        v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
        return np.stack([v, omega + self.yaw_per_metre * v], axis=-1)

    def wheels(self, body: ArrayLike) -> FloatArray:
        """Twists (..., 2) by the wheels for twists (..., 2) of the body: the exact inverse of `body`."""
        v, omega = np.moveaxis(np.asarray(body, dtype=float), -1, 0)
        return np.stack([v, omega - self.yaw_per_metre * v], axis=-1)


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
