"""Two ways to fill a linear system from parameters: a transfer function with two poles, and any state-space model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from models.identification.output_error.linear_system import AnyArray
from models.identification.settings import load_settings
from models.interface import FloatArray


@dataclass(frozen=True)
class TwoPolesStructure:
    """gain w^2 / (s^2 + 2 damping w s + w^2); the parameters are logarithms, so that all stay positive."""

    names: tuple[str, ...] = ("log_gain", "log_natural_frequency", "log_damping")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(3,) bounds from the settings."""
        settings = load_settings()
        ranges = np.log([settings.gain, settings.natural_frequency, settings.damping])
        return ranges[:, 0], ranges[:, 1]

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """The realisation of `models.structures.TwoPoles`."""
        gain, w, damping = np.exp(parameters)
        A = np.array([[0.0, w], [-w, -2 * damping * w]])
        return A, np.array([[0.0], [gain * w]]), np.array([[1.0, 0.0]], dtype=parameters.dtype)

    def recentred(self, parameters: FloatArray) -> tuple[TwoPolesStructure, FloatArray]:
        """Logarithms suit everywhere."""
        return self, parameters


@dataclass(frozen=True)
class LocalStateSpace:
    """Every state-space model near a given one, each exactly once.

    A change of state coordinates moves A, B and C but not the outputs. The parameters run along the orthogonal
    complement of those moves: n (m + p) of them for n states, m inputs and p outputs (data driven local coordinates:
    McKelvey, Helmersson, Ribarits, Automatica 2004, 40(9), 1629-1635). No canonical form is needed, so poles may meet.

    Attributes
    ----------
    A, B, C
        (n, n), (n, m), (p, n): the model at parameters zero.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    basis: FloatArray = field(init=False)
    """(n (n + m + p), n (m + p)) orthonormal: from parameters to the entries of A, B and C."""

    def __post_init__(self) -> None:
        """Find the coordinates."""
        n = len(self.A)
        moves = []
        for unit in np.eye(n * n).reshape(-1, n, n):
            moves.append(
                np.concatenate(
                    [(self.A @ unit - unit @ self.A).ravel(), (-unit @ self.B).ravel(), (self.C @ unit).ravel()]
                )
            )
        left = np.linalg.svd(np.array(moves).T)[0]
        object.__setattr__(self, "basis", left[:, n * n :])

    @property
    def names(self) -> tuple[str, ...]:
        """Numbered: a local coordinate has no meaning of its own."""
        return tuple(f"coordinate_{i}" for i in range(self.basis.shape[1]))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """None."""
        free = np.full(self.basis.shape[1], np.inf)
        return -free, free

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """A (n, n), B (n, m), C (p, n)."""
        n, m = self.B.shape
        A, B, C = np.split(self.basis @ parameters, np.cumsum([n * n, n * m]))
        return self.A + A.reshape(n, n), self.B + B.reshape(n, m), self.C + C.reshape(-1, n)

    def recentred(self, parameters: FloatArray) -> tuple[LocalStateSpace, FloatArray]:
        """The coordinates around the model at `parameters`."""
        A, B, C = self.matrices(parameters)
        return LocalStateSpace(A, B, C), np.zeros_like(parameters)
