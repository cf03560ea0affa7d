"""Velocity model sampled at the control rate, with fractional dead time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.errors import ArgumentError, checked_methods
from diffdrive_mpc.models.interface import FloatArray, checked_array

# Tolerance for dead times that are whole numbers of samples before rounding of their decimals [samples].
_WHOLE = 1e-9


@checked_methods
@dataclass(frozen=True)
class DiscreteModel:
    """x[k+1] = A x[k] + B0 u[k - delay] + B1 u[k - delay - 1],  y[k] = C x[k].

    Column j of B0 and B1 multiplies input j, delayed by `delay[j]` samples; B1 describes the part of the sample in
    which the older command still acts.

    Attributes
    ----------
    A, B0, B1, C, D
        (n, n), (n, 2), (n, 2), (2, n), (2, 2). D is zero, because the velocity of a robot cannot follow its command
        without lag.
    delay
        (2,) whole samples.
    dt
        Sample time [s].
    """

    A: FloatArray
    B0: FloatArray
    B1: FloatArray
    C: FloatArray
    D: FloatArray
    delay: NDArray[np.int64]
    dt: float

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def memory(self) -> int:
        """Number of past commands that still act on future states: max(delay) + 1."""
        return int(self.delay.max()) + 1

    @property
    def dead_samples(self) -> NDArray[np.int64]:
        """(2,) age of the newest command that acts on the state."""
        return self.delay

    @property
    def drive(self) -> FloatArray:
        """(n, 2) effect of a constant command on the states in one sample."""
        return self.B0 + self.B1

    @property
    def dc_gain(self) -> FloatArray:
        """(2, 2) steady-state gain, equal to the gain of the continuous model."""
        return np.asarray(self.C @ np.linalg.solve(np.eye(self.order) - self.A, self.B0 + self.B1))

    def effective_inputs(self, commands: FloatArray, past: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the delayed commands that B0 and B1 multiply.

        Parameters
        ----------
        commands
            (K, 2) commands at samples 0 to K - 1.
        past
            (memory, 2) commands before them, oldest first.

        Returns
        -------
        tuple
            Two arrays (K, 2): u[k - delay] and u[k - delay - 1].
        """
        history = np.vstack([past, commands])
        rows = np.arange(len(commands))[:, None] + self.memory - self.delay
        return history[rows, [0, 1]], history[rows - 1, [0, 1]]

    def settled_state(self, command: ArrayLike) -> FloatArray:
        """Compute the steady state (n,) under the constant `command` (2,)."""
        drive = (self.B0 + self.B1) @ np.asarray(command, dtype=float)
        return np.asarray(np.linalg.solve(np.eye(self.order) - self.A, drive))

    def simulate(
        self, commands: ArrayLike, state: ArrayLike | None = None, past: ArrayLike | None = None
    ) -> FloatArray:
        """Simulate the response to commands.

        Parameters
        ----------
        commands
            (K, 2) v_ref [m/s], omega_ref [rad/s].
        state
            (n,) state at sample 0; zero (at rest) by default.
        past
            (memory, 2) commands before sample 0, oldest first; zero by default.

        Returns
        -------
        FloatArray
            (K, 2) v [m/s] and omega [rad/s] at samples 0 to K - 1.
        """
        commands = checked_array("commands", commands, "numbers of shape (K, 2)", "give v [m/s], omega [rad/s] per row")
        if commands.ndim != 2 or commands.shape[1] != 2:
            raise ArgumentError(f"commands: shape {commands.shape}; give v [m/s], omega [rad/s] per row, shape (K, 2)")
        x = np.zeros(self.order) if state is None else np.array(state, dtype=float)
        before = np.zeros((self.memory, 2)) if past is None else np.asarray(past, dtype=float)
        recent, older = self.effective_inputs(commands, before)
        drive = recent @ self.B0.T + older @ self.B1.T
        states = np.empty((len(commands), self.order))
        for k in range(len(commands)):
            states[k] = x
            x = self.A @ x + drive[k]
        return np.asarray(states @ self.C.T)


def zero_order_hold(A: FloatArray, B: FloatArray, C: FloatArray, dead_time: FloatArray, dt: float) -> DiscreteModel:
    """Sample x' = A x + B u(t - dead_time), y = C x exactly with a zero-order hold.

    With dead_time = delay dt + rest, the command of sample k - delay acts during the last dt - rest of sample k, and
    the command before it during the first `rest`. B0 is the hold matrix over dt - rest, and B0 + B1 the one over dt.

    Parameters
    ----------
    A, B, C
        (n, n), (n, 2), (2, n).
    dead_time
        (2,) [s], not negative.
    dt
        Sample time [s], positive.
    """
    from scipy.linalg import expm  # noqa: PLC0415 - slow import, needed for construction only

    delay = np.floor(dead_time / dt + _WHOLE).astype(np.int64)
    rest = np.maximum(dead_time - delay * dt, 0.0)
    rest[rest < _WHOLE * dt] = 0.0
    n = len(A)
    # With constant inputs as extra states, one exponential contains sampled A and B (Van Loan, IEEE TAC 23(3), 1978).
    extended = np.zeros((n + 2, n + 2))
    extended[:n] = np.hstack([A, B])
    whole = expm(dt * extended)[:n]
    B0 = np.column_stack([expm((dt - rest[j]) * extended)[:n, n + j] for j in (0, 1)])
    return DiscreteModel(
        A=whole[:, :n].copy(),
        B0=B0,
        B1=whole[:, n:] - B0 if rest.any() else np.zeros_like(B0),
        C=C.copy(),
        D=np.zeros((2, 2)),
        delay=delay,
        dt=float(dt),
    )
