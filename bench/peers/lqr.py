"""LTV-LQR along the reference: feed-forward and state feedback with the gains of a backward Riccati recursion.

The state e contains the errors in the frame of the reference (a along the path, c across the path, h of the heading),
the integral of c, and the deviation of the twist from that of the reference (dv, dw):
de/dt = (omega c + dv, -omega a + v h, dw, c, ...), where each twist follows its command with a first-order lag.
Source: B. Anderson, J. Moore, "Optimal control: linear quadratic methods", 1990, chapters 2 and 3.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers.tracking_peer import REST_SPEED, AboveZero, Gains, LawInput, NotNegative, RobotParameters
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

_STATES = 6
_MAX_INTEGRAL = 0.1
"""Maximum absolute integral of the error across the path [m s]."""


class LqrGains(Gains):
    """Weights of the cost; the weight of the squared deviation of v from its feed-forward is 1 s^2/m^2."""

    along: AboveZero = Field(description="weight of the squared error along the path [1/m^2]")
    across: AboveZero = Field(description="weight of the squared error across the path [1/m^2]")
    heading: NotNegative = Field(description="weight of the squared heading error [1/rad^2]")
    integral: NotNegative = Field(description="weight of the squared integral of the error across the path [1/(m s)^2]")
    omega: AboveZero = Field(description="weight of the squared deviation of omega from its feed-forward [s^2/rad^2]")


class LqrLaw:
    """Time-varying state feedback around the reference."""

    gains = LqrGains

    def __init__(self, gains: LqrGains, robot: RobotParameters) -> None:
        self._dt, self._time_constant = robot.sample_time, robot.time_constant
        self._Q = np.diag([gains.along, gains.across, gains.heading, gains.integral, 0.0, 0.0])
        self._R = np.diag([1.0, gains.omega])

    def start(self, reference: Reference) -> None:
        """Compute the gains along `reference`."""
        self._reference, self._integral = reference, 0.0
        count = int(np.ceil(reference.duration / self._dt)) + 1
        twists = reference.sample(self._dt * (np.arange(count) + 0.5)).twist
        # The reference ends at rest; the weights of the state are also the terminal weights.
        self._K, P = np.empty((count, 2, _STATES)), self._Q
        for k in reversed(range(count)):
            self._K[k], P = self._step_backwards(P, *self._linearise(*twists[k]))

    def _linearise(self, v: float, omega: float) -> tuple[FloatArray, FloatArray]:
        """Linearise one sample about a reference of constant twist; return A (6, 6) and B (6, 2).

        The states are the errors along [m] and across [m] the path and of the heading [rad], the integral of the error
        across the path [m s], and the errors of v [m/s] and omega [rad/s].
        """
        dt = self._dt
        decay = np.exp(-dt / self._time_constant)
        A, B = np.eye(_STATES), np.zeros((_STATES, 2))
        A[0, 1], A[1, 0], A[1, 2] = dt * omega, -dt * omega, dt * v
        A[0, 4], A[2, 5] = dt, dt
        # A robot at rest cannot reduce an error across the path, so the error is not integrated.
        A[3, 1] = dt if abs(v) > REST_SPEED else 0.0
        A[4, 4], A[5, 5] = decay
        B[4, 0], B[5, 1] = 1 - decay
        return A, B

    def _step_backwards(self, P: FloatArray, A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the gain K (2, 6) and the cost-to-go (6, 6) of a sample from the cost-to-go P (6, 6) of the next."""
        K = np.asarray(np.linalg.solve(self._R + B.T @ P @ B, B.T @ P @ A), dtype=float)
        cost_to_go = self._Q + A.T @ P @ (A - B @ K)
        return K, np.asarray(0.5 * (cost_to_go + cost_to_go.T))

    def decide(self, law_input: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        deviation = law_input.motion.pose - law_input.reference
        along, across = ahead_and_left(deviation, law_input.reference[2])
        twist = self._reference.sample([law_input.time]).twist[0]
        if abs(twist[0]) > REST_SPEED:
            self._integral = float(np.clip(self._integral + self._dt * across, -_MAX_INTEGRAL, _MAX_INTEGRAL))
        state = np.array([along, across, deviation[2], self._integral, *(law_input.motion.twist - twist)])
        row = min(max(int(law_input.time / self._dt), 0), len(self._K) - 1)
        return np.asarray(law_input.feed_forward - self._K[row] @ state)
