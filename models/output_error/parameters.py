"""Named numbers with their covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.interface import FloatArray

# Central differences of smooth functions: the cube root of the machine precision balances cut-off and rounding.
_STEP = 6e-6


@dataclass(frozen=True)
class ParameterEstimate:
    """Parameters as an estimator found them.

    Attributes
    ----------
    names
        (q,) such as "v.gain".
    values
        (q,).
    covariance
        (q, q).
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray

    @property
    def standard_deviation(self) -> FloatArray:
        """(q,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def value(self, name: str) -> float:
        """One parameter; raises KeyError when there is none of that name."""
        return float(self.values[self._index(name)])

    def deviation(self, name: str) -> float:
        """Its standard deviation; raises KeyError when there is none of that name."""
        return float(self.standard_deviation[self._index(name)])

    def derived(self, names: Sequence[str], function: Callable[[FloatArray], FloatArray]) -> ParameterEstimate:
        """What a function (q,) to (r,) makes of the parameters, its covariance to first order."""
        slopes = []
        for i, value in enumerate(self.values):
            step = _STEP * max(abs(value), 1e-3) * np.eye(len(self.values))[i]
            slopes.append((function(self.values + step) - function(self.values - step)) / (2 * step[i]))
        slope = np.array(slopes).T
        return ParameterEstimate(tuple(names), np.asarray(function(self.values)), slope @ self.covariance @ slope.T)

    def part(self, names: Sequence[str]) -> ParameterEstimate:
        """Some of the parameters; raises KeyError when there is none of a name."""
        rows = [self._index(name) for name in names]
        return ParameterEstimate(tuple(names), self.values[rows], self.covariance[np.ix_(rows, rows)])

    def renamed(self, prefix: str) -> ParameterEstimate:
        """The same parameters, their names behind `prefix` and a dot."""
        return ParameterEstimate(tuple(f"{prefix}.{name}" for name in self.names), self.values, self.covariance)

    def _index(self, name: str) -> int:
        if name not in self.names:
            raise KeyError(f"no parameter '{name}': there are {', '.join(self.names)}")
        return self.names.index(name)


def joined(estimates: Sequence[ParameterEstimate]) -> ParameterEstimate:
    """Independent estimates side by side."""
    return ParameterEstimate(
        tuple(name for estimate in estimates for name in estimate.names),
        np.concatenate([estimate.values for estimate in estimates]),
        linalg.block_diag(*(estimate.covariance for estimate in estimates)),
    )
