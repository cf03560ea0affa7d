"""Two ways to fill a linear system from parameters: a transfer function with two poles, and any state-space model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from diffdrive_mpc.models.identification.output_error.linear_system import AnyArray
from diffdrive_mpc.models.identification.settings import load_settings
from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True)
class TwoPolesStructure:
    """gain / (1 + lag s + lag short s^2), two poles and no zeros; the parameters are logarithms of these three.

    Poles may be complex, and one may be far faster than the other, without any parameter going to extremes.

    Attributes
    ----------
    shortest
        Least value of `short` [s]; that of the settings by default.
    """

    shortest: float | None = None
    names: tuple[str, ...] = ("log_gain", "log_lag", "log_short")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(3,) bounds from the settings."""
        settings = load_settings()
        short = (self.shortest or settings.short[0], settings.short[1])
        ranges = np.log([settings.gain, settings.lag, short])
        return ranges[:, 0], ranges[:, 1]

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """The realisation of `models.structures.TwoPoles`."""
        gain, w, damping = two_poles(parameters)
        A = np.array([[0.0, w], [-w, -2 * damping * w]])
        return A, np.array([[0.0], [gain * w]]), np.array([[1.0, 0.0]], dtype=parameters.dtype)

    def recentred(self, parameters: FloatArray) -> tuple[TwoPolesStructure, FloatArray]:
        """Logarithms suit everywhere."""
        return self, parameters


def two_poles(parameters: AnyArray) -> AnyArray:
    """(3,) gain [-], natural frequency [rad/s] and damping [-] of the parameters of `TwoPolesStructure`."""
    gain, lag, short = np.exp(parameters)
    return np.array([gain, 1 / np.sqrt(lag * short), 0.5 * np.sqrt(lag / short)])


def two_poles_parameters(gain: float, natural_frequency: float, damping: float) -> FloatArray:
    """(3,) the inverse of `two_poles`."""
    return np.log([gain, 2 * damping / natural_frequency, 0.5 / (damping * natural_frequency)])


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
