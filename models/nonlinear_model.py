"""A velocity model that is a function: for robots whose answer to a command depends on how they move."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import ModelError


@dataclass(frozen=True)
class NonlinearModel:
    """x[k+1] = step(x[k], window), y[k] = output(x[k]); window = (u[k - memory], ..., u[k]), oldest first.

    u = (v_ref [m/s], omega_ref [rad/s]), y = (v [m/s], omega [rad/s]). A model without states of its own, such as a
    network on past commands, keeps its last output as its state: step gives that from the window alone. It has to rest
    at x = 0 under u = 0.

    Attributes
    ----------
    name
        Name for tables and messages.
    step
        CasADi function (x (n), window (2 (memory + 1))) -> x (n), over one sample.
    output
        CasADi function (x (n)) -> y (2).
    dt
        Sample time that `step` is for [s].
    memory
        Number of past commands that still act on the future, at least 1.

    Raises
    ------
    ModelError
        If shapes do not fit, or it does not rest, or its linearisation at rest is unstable or has no gain.
    """

    name: str
    step: ca.Function
    output: ca.Function
    dt: float
    memory: int = 1
    delay: NDArray[np.int64] = field(default_factory=lambda: np.zeros(2, dtype=np.int64), repr=False)
    """(2,) zero: dead time lies in the window."""

    def __post_init__(self) -> None:
        """Check shapes, rest and stability."""
        where, n = f"model '{self.name}'", self.order
        shapes = {
            "step, x": (self.step.size1_in(0), n),
            "step, window": (self.step.size1_in(1), 2 * (self.memory + 1)),
            "step, result": (self.step.size1_out(0), n),
            "output, result": (self.output.size1_out(0), 2),
        }
        for place, (found, wanted) in shapes.items():
            if found != wanted:
                raise ModelError(f"{where}: {place} has {found} numbers, expected {wanted}")
        rest = np.concatenate([np.array(self.step(np.zeros(n), 0)).ravel(), np.array(self.output(np.zeros(n))).ravel()])
        if not (np.isfinite(rest).all() and np.abs(rest).max() < 1e-9):
            raise ModelError(f"{where}: it must rest at x = 0 under commands of zero; shift its states")
        A = self.linearised[0]
        radius = np.abs(np.linalg.eigvals(A)).max()
        if not radius < 1:
            raise ModelError(f"{where}: unstable at rest, a state grows by {radius:.3g} each sample")
        if not (np.isfinite(self.dc_gain).all() and np.diag(self.dc_gain).min() > 0):
            raise ModelError(f"{where}: steady-state gains {np.diag(self.dc_gain)} at rest; they must be positive")

    @property
    def order(self) -> int:
        """Number of states n."""
        return int(self.output.size1_in(0))

    @cached_property
    def linearised(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A (n, n), B (n, 2) summed over the window, and C (2, n), at rest."""
        x, window = ca.SX.sym("x", self.order), ca.SX.sym("window", 2 * (self.memory + 1))
        after, y = self.step(x, window), self.output(x)
        jacobians = ca.Function(
            "jacobians", [x, window], [ca.jacobian(after, x), ca.jacobian(after, window), ca.jacobian(y, x)]
        )
        A, by_window, C = (np.array(part) for part in jacobians(0, 0))
        return A, by_window.reshape(self.order, -1, 2).sum(axis=1), C

    @property
    def drive(self) -> FloatArray:
        """(n, 2) what a command held over the whole window adds to the states in one sample, at rest."""
        return self.linearised[1]

    @property
    def settled(self) -> FloatArray:
        """(n, 2) state after a small unit command for ever."""
        A, B, _ = self.linearised
        return np.asarray(np.linalg.solve(np.eye(self.order) - A, B))

    @property
    def dc_gain(self) -> FloatArray:
        """(2, 2) steady-state gain at rest."""
        return np.asarray(self.linearised[2] @ self.settled)

    @cached_property
    def lag(self) -> FloatArray:
        """(2,) mean delay of each channel [s] for small commands: how long a step's answer stays behind."""
        missing = np.zeros(2)
        for channel in (0, 1):
            step = np.zeros(2)
            step[channel] = 1e-4
            answers = self.simulate(np.tile(step, (2000, 1)))[:, channel] / (
                step[channel] * self.dc_gain[channel, channel]
            )
            missing[channel] = self.dt * (np.sum(1.0 - answers[1:]) + 0.5)
        return missing

    def simulate(self, commands: ArrayLike) -> FloatArray:
        """Free run from rest: (K, 2) v [m/s], omega [rad/s] at the samples of `commands` (K, 2)."""
        commands = np.asarray(commands, dtype=float)
        line = np.vstack([np.zeros((self.memory, 2)), commands])
        x, outputs = np.zeros(self.order), np.empty((len(commands), 2))
        for k in range(len(commands)):
            outputs[k] = np.array(self.output(x)).ravel()
            x = np.array(self.step(x, line[k : k + self.memory + 1].ravel())).ravel()
        return outputs
