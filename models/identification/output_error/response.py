"""The states of a sampled linear system under any drive, without a Python loop over time."""

from __future__ import annotations

import numpy as np
from scipy import linalg, signal

from diffdrive_mpc.models.interface import FloatArray


class StateResponse:
    """The states of x[k + 1] = A x[k] + drive[k], for any number of drives.

    In Schur coordinates A is triangular, so that each state is a first-order filter of the states after it; unlike a
    diagonal form this stays exact where poles meet.

    Parameters
    ----------
    A
        (n, n).
    """

    def __init__(self, A: FloatArray) -> None:
        triangle, basis = linalg.schur(A)
        if np.any(np.diag(triangle, -1)):  # complex poles
            triangle, basis = linalg.rsf2csf(triangle, basis)
        self._triangle, self._basis = triangle, basis

    def __call__(self, drive: FloatArray, start: FloatArray | None = None) -> FloatArray:
        """States (n, S, K) at samples 0 to K - 1.

        Parameters
        ----------
        drive
            (n, S, K): S drives of K samples.
        start
            (n, S) states at sample 0; zero by default.
        """
        adjoint, triangle = self._basis.conj().T, self._triangle
        states = np.tensordot(adjoint, drive, 1)
        first = np.tensordot(adjoint, np.zeros(drive.shape[:2]) if start is None else start, 1)
        for i in reversed(range(len(states))):
            for j in range(i + 1, len(states)):
                if triangle[i, j] != 0.0:
                    states[i] += triangle[i, j] * states[j]
            # lfilter's memory ahead of sample 0 is the state there.
            states[i] = signal.lfilter([0.0, 1.0], [1.0, -triangle[i, i]], states[i], zi=first[i][:, None])[0]
        return np.asarray(np.tensordot(self._basis, states, 1).real)
