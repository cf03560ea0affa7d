"""Checks that hold for every reference trajectory."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories import Trajectory, TrajectoryLimits

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def largest_integration_gap(trajectory: Trajectory, breaks: FloatArray, pieces: int) -> float:
    """Return the maximum difference between the sampled pose and arc length and the quadrature of the sampled twist.

    Each interval between `breaks`, within which the trajectory is smooth, is divided into `pieces`.
    """
    shares = np.arange(pieces) / pieces
    times = np.append((breaks[:-1, None] + np.diff(breaks)[:, None] * shares).ravel(), breaks[-1])
    nodes = times[:-1, None] + np.diff(times)[:, None] * (_NODES + 1) / 2
    sample = trajectory.sample(nodes.ravel())
    v, omega = sample.twist.T
    theta = sample.pose[:, 2]
    rates = np.stack([v * np.cos(theta), v * np.sin(theta), omega, np.abs(v)]).reshape(4, *nodes.shape)
    steps = (rates @ _WEIGHTS) * np.diff(times) / 2
    reference = trajectory.sample(times)
    sampled = np.column_stack([reference.pose, reference.arc_length]).T
    return float(np.abs(sampled[:, :1] + np.cumsum(steps, axis=1) - sampled[:, 1:]).max(initial=0.0))


def largest_shares(trajectory: Trajectory, limits: TrajectoryLimits, step: float = 1e-3) -> FloatArray:
    """Return maximum speeds and finite-difference accelerations (4,), as shares of the limits, including both ends."""
    times = np.arange(-5 * step, trajectory.duration + 5 * step, step)
    twist = trajectory.sample(times).twist
    speed = np.abs(twist).max(axis=0) / (limits.v, limits.omega)
    # A difference quotient over a step cannot exceed the maximum derivative inside it.
    acceleration = np.abs(np.diff(twist, axis=0)).max(axis=0) / step
    return np.concatenate([speed, acceleration / (limits.v_acceleration, limits.omega_acceleration)])


def assert_holds_its_ends(trajectory: Trajectory) -> None:
    """Check that the robot rests at the start pose before the trajectory and at the end pose after it."""
    end = trajectory.duration
    sample = trajectory.sample([-10.0, -1e-9, 0.0, end, end + 1e-9, end + 10.0])
    assert np.array_equal(sample.pose[:2], sample.pose[[2, 2]])
    np.testing.assert_allclose(sample.pose[4:], sample.pose[[3, 3]], rtol=0, atol=1e-9)
    assert np.array_equal(sample.twist[[0, 1, 4, 5]], np.zeros((4, 2)))
    assert sample.arc_length[0] == 0.0
    assert sample.arc_length[-1] == sample.arc_length[3]
