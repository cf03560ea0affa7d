"""LTV-LQR along the reference: feed-forward, and state feedback whose gains come from a Riccati recursion backwards.

The state is the error in the reference's frame, its integral across the path, and the twist's lag behind the reference:
de/dt = (omega c + dv, -omega a + v h, dw, c, ...) with each twist a first-order lag behind its command. The textbook
form: B. Anderson, J. Moore, "Optimal control: linear quadratic methods", 1990, chapters 2 and 3.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers.tracking_peer import STANDING, AboveZero, Delayed, Gains, LawInput, NotNegative
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

_STATES = 6
_MAX_INTEGRAL = 0.1
"""Bound of the integral of the error across the path [m s]."""


class LqrGains(Gains):
    """Weights, relative to a weight of 1 s^2/m^2 of the deviation of v from its feed-forward."""

    along: AboveZero = Field(description="squared error along the path [1/m^2]")
    across: AboveZero = Field(description="squared error across the path [1/m^2]")
    heading: NotNegative = Field(description="squared heading error [1/rad^2]")
    integral: NotNegative = Field(description="squared integral of the error across the path [1/(m s)^2]")
    omega: AboveZero = Field(description="squared deviation of omega from its feed-forward [s^2/rad^2]")


class LqrLaw:
    """Time-varying state feedback around the reference."""

    gains = LqrGains

    def __init__(self, gains: LqrGains, robot: Delayed) -> None:
        self._dt, self._time_constant = robot.sample_time, robot.time_constant
        self._Q = np.diag([gains.along, gains.across, gains.heading, gains.integral, 0.0, 0.0])
        self._R = np.diag([1.0, gains.omega])

    def start(self, reference: Reference) -> None:
        """Compute the gains along `reference`."""
        self._reference, self._integral = reference, 0.0
        count = int(np.ceil(reference.duration / self._dt)) + 1
        twists = reference.sample(self._dt * (np.arange(count) + 0.5)).twist
        # The reference rests at its end; the state weights are also the terminal weights.
        self._K, P = np.empty((count, 2, _STATES)), self._Q
        for k in reversed(range(count)):
            self._K[k], P = self.backwards(P, *self.linearised(*twists[k]))

    def linearised(self, v: float, omega: float) -> tuple[FloatArray, FloatArray]:
        """Linearise one sample around a reference of constant twist: A (6, 6) and B (6, 2).

        The states are the error along [m], across [m] and of heading [rad], the integral of the error across [m s], and
        the error of v [m/s] and omega [rad/s].
        """
        dt = self._dt
        decay = np.exp(-dt / self._time_constant)
        A, B = np.eye(_STATES), np.zeros((_STATES, 2))
        A[0, 1], A[1, 0], A[1, 2] = dt * omega, -dt * omega, dt * v
        A[0, 4], A[2, 5] = dt, dt
        # A standing robot cannot reduce an error across, so the integral must not grow.
        A[3, 1] = dt if abs(v) > STANDING else 0.0
        A[4, 4], A[5, 5] = decay
        B[4, 0], B[5, 1] = 1 - decay
        return A, B

    def backwards(self, P: FloatArray, A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute gain K (2, 6) and cost-to-go (6, 6) one sample before cost-to-go P (6, 6)."""
        K = np.asarray(np.linalg.solve(self._R + B.T @ P @ B, B.T @ P @ A), dtype=float)
        before = self._Q + A.T @ P @ (A - B @ K)
        return K, np.asarray(0.5 * (before + before.T))

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        gap = sight.motion.pose - sight.reference
        along, across = ahead_and_left(gap, sight.reference[2])
        expected = self._reference.sample([sight.time]).twist[0]
        if abs(expected[0]) > STANDING:
            self._integral = float(np.clip(self._integral + self._dt * across, -_MAX_INTEGRAL, _MAX_INTEGRAL))
        state = np.array([along, across, gap[2], self._integral, *(sight.motion.twist - expected)])
        row = min(max(int(sight.time / self._dt), 0), len(self._K) - 1)
        return np.asarray(sight.feed_forward - self._K[row] @ state)
