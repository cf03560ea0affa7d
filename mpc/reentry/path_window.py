"""Sampled section of the reference around its current time, and the robot's position relative to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.two_sided import sides_at
from diffdrive_mpc.mpc.config.fixed_values import STANDING
from diffdrive_mpc.mpc.reentry.quintic_path import Paths
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# A path may cross itself. The search for the nearest sample therefore adds two terms to the distance: this share of the
# arc length between the sample and the current reference [-], and the time between them multiplied by this speed [m/s].
_PATH_AS_DISTANCE = 0.5
_TIME_AS_DISTANCE = 0.02


@dataclass(frozen=True)
class PathWindow:
    """Samples of the reference at n evenly spaced times.

    Attributes
    ----------
    times
        (n,) reference time [s].
    pose
        (n, 3) x, y [m], theta [rad].
    twist
        (n, 2) v [m/s], omega [rad/s].
    arc_length
        (n,) arc length of the path [m].
    travel
        (n,) direction of travel: 1 forwards, -1 backwards; at standstill, the direction of the next motion.
    """

    times: FloatArray
    pose: FloatArray
    twist: FloatArray
    arc_length: FloatArray
    travel: FloatArray

    @classmethod
    def sample_around(cls, reference: Reference, time: float, span: float, step: float) -> PathWindow:
        """Sample `reference` within its duration from `time - span` to `time + span` [s], about every `step` [s]."""
        start = min(max(0.0, time - span), reference.duration)
        end = max(min(reference.duration, time + span), start)
        times = np.linspace(start, end, max(2, math.ceil((end - start) / step) + 1))
        sample = reference.sample(times)
        return cls(times, sample.pose, sample.twist, sample.arc_length, _travel(sample.twist[:, 0]))

    def index(self, time: float) -> int:
        """Return the index of the sample nearest to `time` [s]."""
        return int(np.argmin(np.abs(self.times - time)))

    def nearest(self, pose: FloatArray, time: float) -> int:
        """Find the sample nearest to the position of `pose` (3,), with preference for samples near `time` [s]."""
        offset = self.pose[:, :2] - pose[:2]
        path = np.abs(self.arc_length - np.interp(time, self.times, self.arc_length))
        away = np.hypot(offset[:, 0], offset[:, 1])
        return int(np.argmin(away + _PATH_AS_DISTANCE * path + _TIME_AS_DISTANCE * np.abs(self.times - time)))

    def position_at(self, pose: FloatArray, index: int) -> tuple[float, float]:
        """Return the position of `pose` (3,) along and across the heading of the sample `index` [m], positive left."""
        x, y, theta = self.pose[index].tolist()
        return in_path(pose[0] - x, pose[1] - y, theta)


def in_path(dx: float, dy: float, theta: float) -> tuple[float, float]:
    """Split a displacement [m] into parts along and across the heading `theta` [rad], positive to its left."""
    # Functions of `math` return NaN for NaN without a warning; the caller checks the result.
    c, s, dx, dy = math.cos(theta), math.sin(theta), float(dx), float(dy)
    return c * dx + s * dy, c * dy - s * dx


def _travel(v: FloatArray) -> FloatArray:
    """Compute the sign of `v` (n,); at rest, use the sign of the next moving sample, or else of the last one."""
    moving = np.flatnonzero(np.abs(v) > STANDING)
    if not moving.size:
        return np.ones_like(v)
    index = np.minimum(np.searchsorted(moving, np.arange(v.size)), moving.size - 1)
    return np.asarray(np.sign(v[moving[index]]))


# Minimum distance between two points that defines a direction [m].
SAME_PLACE = 0.01
# Duration of an empty motion [s]; the duration of a trajectory must be positive.
_MIN_DURATION = 1e-3


class MotionLine:
    """Builder of a motion from segments that are appended to a start pose (3,) [m, m, rad]."""

    def __init__(self, pose: FloatArray) -> None:
        self._times = [0.0]
        self._poses = [np.asarray(pose, dtype=float)]
        self._rates = [np.zeros(3)]

    def brake(self, v: float, omega: float, duration: float) -> None:
        """Append braking from v [m/s], omega [rad/s] to rest at constant deceleration over `duration` [s]."""
        start = self._poses[-1]
        for share in np.linspace(0.0, 1.0, 5):
            # Ratio of the distance to the initial speed, for a speed that decreases linearly.
            effective_time = duration * (share - 0.5 * share * share)
            pose = integrate_pose(start, v, omega, effective_time)
            speed, heading = v * (1.0 - share), pose[2]
            rate = np.array([speed * np.cos(heading), speed * np.sin(heading), omega * (1.0 - share)])
            if share == 0.0:
                self._rates[-1] = rate
            else:
                self._add(duration / 4.0, pose, rate)

    def turn(self, angle: float, limits: TrajectoryLimits) -> None:
        """Append a turn on the spot by `angle` [rad], from rest to rest."""
        if not angle:
            return
        size, side, alpha = abs(angle), np.sign(angle), limits.omega_acceleration
        peak = min(limits.omega, np.sqrt(alpha * size))
        ramp, cruise = peak / alpha, size / peak - peak / alpha
        start = self._poses[-1]
        for duration, angle_so_far, rate in (
            (ramp, 0.5 * peak * ramp, peak),
            (cruise, size - 0.5 * peak * ramp, peak),
            (ramp, size, 0.0),
        ):
            # Rounding can result in a short cruise in a triangular profile.
            if duration > 1e-9:
                self._add(duration, start + [0.0, 0.0, side * angle_so_far], np.array([0.0, 0.0, side * rate]))

    def drive(self, paths: Paths, index: int, speed: FloatArray, times: FloatArray, travel: float) -> None:
        """Append path `index` with speeds (K,) [m/s] at times (K,) [s]; backwards if `travel` is -1.

        A path that is not longer than `SAME_PLACE` is omitted, since its direction is undefined.
        """
        if paths.lengths[index].sum() <= SAME_PLACE:
            return
        direction = paths.heading[index]
        # Unwrap the heading so that it continues the heading of the previous segment.
        heading = direction - (0.0 if travel > 0 else np.pi)
        heading += 2 * np.pi * np.round((self._poses[-1][2] - heading[0]) / (2 * np.pi))
        poses = np.column_stack([paths.points[index], heading])
        rates = speed[:, None] * np.column_stack([np.cos(direction), np.sin(direction), paths.curvature[index]])
        self._rates[-1] = rates[0]
        for duration, pose, rate in zip(np.diff(times), poses[1:], rates[1:], strict=True):
            self._add(float(duration), pose, rate)

    def trajectory(self, name: str, end_heading: float) -> SplineTrajectory:
        """Convert the motion to a trajectory that ends at `end_heading` [rad], by adding multiples of 2 pi."""
        if len(self._times) == 1:
            self._add(_MIN_DURATION, self._poses[0], np.zeros(3))
        poses = np.array(self._poses)
        poses[:, 2] += 2 * np.pi * np.round((end_heading - poses[-1, 2]) / (2 * np.pi))
        return SplineTrajectory.through(name, np.array(self._times), poses, np.array(self._rates))

    def _add(self, duration: float, pose: FloatArray, rate: FloatArray) -> None:
        self._times.append(self._times[-1] + duration)
        self._poses.append(pose)
        self._rates.append(rate)


def braking_time(v: float, omega: float, limits: TrajectoryLimits) -> float:
    """Compute the time [s] to brake from the twist (v, omega) to rest at the acceleration limits."""
    return max(abs(v) / limits.v_acceleration, abs(omega) / limits.omega_acceleration)


def turning_times(angles: FloatArray, limits: TrajectoryLimits) -> FloatArray:
    """Compute the times (C,) [s] of turns on the spot by `angles` (C,) [rad], from rest to rest."""
    size, alpha = np.abs(angles), limits.omega_acceleration
    peak = np.minimum(limits.omega, np.sqrt(alpha * size))
    return np.asarray(peak / alpha + size / np.maximum(peak, 1e-9))


def path_speeds(
    paths: Paths, enter: FloatArray, leave: FloatArray, limits: TrajectoryLimits, shares: FloatArray, travel: FloatArray
) -> FloatArray:
    """Compute the maximum speed at the nodes of each path.

    The bounds on each piece are those of `mpc.trajectories.path_timing.squared_speeds`, for C paths at once and with
    desired speeds at both ends. If a path is too short or too tight for the desired speeds, the speeds at its ends are
    lower.

    Parameters
    ----------
    paths
        C paths of K nodes.
    enter, leave
        (C,) desired speed at the first and last node [m/s], not negative.
    limits
        Speed and acceleration limits.
    shares
        (S,) shares of the speed limit [-]; each path is timed with each share.
    travel
        (C,) direction of travel: 1 forwards, -1 backwards.

    Returns
    -------
    FloatArray
        (S, C, K) speeds [m/s].
    """
    k, lengths = np.abs(paths.curvature), paths.lengths
    # Curvature halfway, for a mean curvature by Simpson's rule: near a cusp it is larger than that of both nodes.
    halfway = 1.5 * np.diff(paths.heading, axis=1) / lengths - 0.25 * (paths.curvature[:, 1:] + paths.curvature[:, :-1])
    max_curvature = np.maximum(np.maximum(k[:, 1:], k[:, :-1]), np.abs(halfway))
    curvature_rate = np.abs(np.diff(paths.curvature, axis=1)) / lengths
    with np.errstate(divide="ignore", over="ignore"):
        # Bounds of the squared speed: |k| v <= omega_max, and |dk/ds| v^2 <= alpha_max at constant speed.
        cap = np.minimum((limits.omega / max_curvature) ** 2, limits.omega_acceleration / curvature_rate)
    # The first axis is that of the nodes, so that each step of a pass uses contiguous memory.
    square = np.empty((k.shape[1], shares.size, len(k)))
    square[1:-1] = np.minimum(cap[:, 1:], cap[:, :-1]).T[:, None]
    square[0] = np.minimum(enter**2, cap[:, 0])
    square[-1] = np.minimum(leave**2, cap[:, -1])
    # The ramps between the speeds at the ends and the cruise speed use half of the acceleration limit.
    distance = np.concatenate([np.zeros((len(k), 1)), np.cumsum(lengths, axis=1)], axis=1)
    ramps = np.maximum(
        enter[:, None] ** 2 - limits.v_acceleration * distance,
        leave[:, None] ** 2 - limits.v_acceleration * (distance[:, -1:] - distance),
    )
    max_speed = sides_at(limits.v, travel)
    cruise = np.maximum((shares[:, None] * max_speed) ** 2, ramps.T[:, None])
    square = np.minimum(square, np.minimum(cruise, max_speed**2))
    # Increase of v^2 from b0 to b1 on a piece: b1 <= b0 + 2 a_max ds, and |dk/ds| b1 + |k| (b1 - b0) / (2 ds) <=
    # alpha_max, solved for b1.
    rise = (2.0 * limits.v_acceleration * lengths).T
    lever = (max_curvature / (2.0 * lengths)).T
    total = np.maximum(curvature_rate.T + lever, 1e-12)
    offset, slope = limits.omega_acceleration / total, lever / total
    # The forward pass limits acceleration, the backward pass braking.
    for i in range(len(rise)):
        bound = np.minimum(square[i] + rise[i], offset[i] + slope[i] * square[i])
        np.minimum(square[i + 1], bound, out=square[i + 1])
    for i in reversed(range(len(rise))):
        bound = np.minimum(square[i + 1] + rise[i], offset[i] + slope[i] * square[i + 1])
        np.minimum(square[i], bound, out=square[i])
    return np.asarray(np.sqrt(np.moveaxis(square, 0, -1)))


def travel_times(paths: Paths, speed: FloatArray) -> FloatArray:
    """Compute the times at the nodes [s] for speeds (..., C, K) and constant acceleration on each piece."""
    times = np.zeros_like(speed)
    np.cumsum(2.0 * paths.lengths / np.maximum(speed[..., 1:] + speed[..., :-1], 1e-9), axis=-1, out=times[..., 1:])
    return times
