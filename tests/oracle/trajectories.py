"""Trajectories sampled with NumPy, from the tables of the product."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import Reference, ReferenceSample
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory
from diffdrive_mpc.mpc.trajectories.moved import MovedReference
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from oracle.motion import arc


class _Resampled:
    """Trajectory with the name and duration of its original."""

    original: ArcTrajectory | SplineTrajectory

    @property
    def name(self) -> str:
        """Name of the original."""
        return self.original.name

    @property
    def duration(self) -> float:
        """Duration of the original [s]."""
        return self.original.duration


@dataclass(frozen=True)
class Arcs(_Resampled):
    """Arcs with piecewise constant acceleration along them; see `ArcTrajectory`."""

    original: ArcTrajectory

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]."""
        t = np.clip(np.atleast_1d(np.asarray(times, dtype=float)), 0.0, self.duration)
        phase = np.searchsorted(self.original.breaks, t, side="right") - 1
        start, x, y, theta, arc_length, forward, turn, offset, rate, half_acceleration = self.original.table[:, phase]
        tau = t - start
        progress = offset + rate * tau + half_acceleration * tau**2
        speed = rate + 2 * half_acceleration * tau
        # As a function of progress, the path is an arc of constant twist.
        dx, dy, _ = arc(theta, forward * progress, turn * progress, 1.0)
        pose = np.column_stack([x + dx, y + dy, theta + turn * progress])
        twist = np.column_stack([forward * speed, turn * speed])
        return ReferenceSample(pose, twist, arc_length + np.abs(forward * progress))


@dataclass(frozen=True)
class Splines(_Resampled):
    """Cubics of x, y, theta and arc length in time; see `SplineTrajectory`."""

    original: SplineTrajectory

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; outside the trajectory the robot rests."""
        times = np.atleast_1d(np.asarray(times, dtype=float))
        t = np.clip(times, 0.0, self.duration)
        piece = np.searchsorted(self.original.breaks[1:-1], t, side="right")
        tau = t - self.original.breaks[piece]
        a, b, c, d = self.original.table[:, piece].reshape(4, 4, -1)
        x, y, theta, arc_length = a * tau**3 + b * tau**2 + c * tau + d
        x_rate, y_rate, omega, _ = 3 * a * tau**2 + 2 * b * tau + c
        v = x_rate * np.cos(theta) + y_rate * np.sin(theta)
        is_inside = (times == t)[:, None]
        twist = np.where(is_inside, np.column_stack([v, omega]), 0.0)
        return ReferenceSample(np.column_stack([x, y, theta]), twist, arc_length)


def with_numpy_samples(reference: Reference) -> Reference:
    """Return the reference, with samples computed by this module if it has a table."""
    if isinstance(reference, MovedReference):
        return replace(reference, original=with_numpy_samples(reference.original))
    if isinstance(reference, ArcTrajectory):
        return Arcs(reference)
    return Splines(reference) if isinstance(reference, SplineTrajectory) else reference
