"""The pieces of a connection in time: braking, turning on the spot, driving a path; put together to a trajectory."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.mpc.reentry.quintic_path import Paths
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# Closer than this, there is no direction from one point to another [m].
SAME_PLACE = 0.01
# A motion that is none at all takes this time [s]: a trajectory needs some.
_MOMENT = 1e-3


class MotionLine:
    """Nodes of a motion, collected piece by piece from a start pose (3,) [m, m, rad]."""

    def __init__(self, pose: FloatArray) -> None:
        self._times = [0.0]
        self._poses = [np.asarray(pose, dtype=float)]
        self._rates = [np.zeros(3)]

    def brake(self, v: float, omega: float, duration: float) -> None:
        """Come to rest from the twist (v [m/s], omega [rad/s]) at constant decelerations over `duration` [s]."""
        start = self._poses[-1]
        for share in np.linspace(0.0, 1.0, 5):
            passed = duration * (share - 0.5 * share * share)
            pose = integrate_pose(start, v, omega, passed)
            speed, heading = v * (1.0 - share), pose[2]
            rate = np.array([speed * np.cos(heading), speed * np.sin(heading), omega * (1.0 - share)])
            if share == 0.0:
                self._rates[-1] = rate
            else:
                self._add(duration / 4.0, pose, rate)

    def turn(self, angle: float, limits: TrajectoryLimits) -> None:
        """Turn on the spot by `angle` [rad], from rest to rest."""
        if not angle:
            return
        size, side, alpha = abs(angle), np.sign(angle), limits.omega_acceleration
        peak = min(limits.omega, np.sqrt(alpha * size))
        ramp, cruise = peak / alpha, size / peak - peak / alpha
        start = self._poses[-1]
        for duration, turned, rate in (
            (ramp, 0.5 * peak * ramp, peak),
            (cruise, size - 0.5 * peak * ramp, peak),
            (ramp, size, 0.0),
        ):
            # Rounding leaves the cruise of a triangle a hair off zero.
            if duration > 1e-9:
                self._add(duration, start + [0.0, 0.0, side * turned], np.array([0.0, 0.0, side * rate]))

    def drive(self, paths: Paths, chosen: int, speed: FloatArray, times: FloatArray, travel: float) -> None:
        """Drive path `chosen` with speeds (K,) at times (K,) [s]; backwards where `travel` is -1.

        A path that is no longer than `SAME_PLACE` is not driven: it has no direction.
        """
        if paths.lengths[chosen].sum() <= SAME_PLACE:
            return
        direction = paths.heading[chosen]
        turned = 0.0 if travel > 0 else np.pi
        # On the turn that the motion so far has reached.
        heading = direction - turned
        heading += 2 * np.pi * np.round((self._poses[-1][2] - heading[0]) / (2 * np.pi))
        poses = np.column_stack([paths.points[chosen], heading])
        rates = speed[:, None] * np.column_stack([np.cos(direction), np.sin(direction), paths.curvature[chosen]])
        self._rates[-1] = rates[0]
        for duration, pose, rate in zip(np.diff(times), poses[1:], rates[1:], strict=True):
            self._add(float(duration), pose, rate)

    def trajectory(self, name: str, end_heading: float) -> SplineTrajectory:
        """The motion as a trajectory, counted on the turn that meets `end_heading` [rad]."""
        if len(self._times) == 1:
            self._add(_MOMENT, self._poses[0], np.zeros(3))
        poses = np.array(self._poses)
        poses[:, 2] += 2 * np.pi * np.round((end_heading - poses[-1, 2]) / (2 * np.pi))
        return SplineTrajectory.through(name, np.array(self._times), poses, np.array(self._rates))

    def _add(self, duration: float, pose: FloatArray, rate: FloatArray) -> None:
        self._times.append(self._times[-1] + duration)
        self._poses.append(pose)
        self._rates.append(rate)


def braking_time(v: float, omega: float, limits: TrajectoryLimits) -> float:
    """Time to come to rest from a twist within the acceleration limits [s]."""
    return max(abs(v) / limits.v_acceleration, abs(omega) / limits.omega_acceleration)


def turning_times(angles: FloatArray, limits: TrajectoryLimits) -> FloatArray:
    """Time to turn on the spot by each of `angles` (C,) [rad], from rest to rest [s]."""
    size, alpha = np.abs(angles), limits.omega_acceleration
    peak = np.minimum(limits.omega, np.sqrt(alpha * size))
    return np.asarray(peak / alpha + size / np.maximum(peak, 1e-9))
