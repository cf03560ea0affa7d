"""Parameters of the estimator: named estimates with covariance, and layouts of parameter vectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Protocol

import numpy as np
from scipy import linalg

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.state_space import LinearSystem

# Relative step of central differences; the cube root of the machine precision balances truncation and rounding errors.
_STEP = 6e-6
# Upper bound of limits of commands and rates, above the limits of all robots; undetermined limits move towards it.
_MAX_LIMIT = 1e3


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimated parameters.

    Attributes
    ----------
    names
        (q,) names, such as "v.gain".
    values
        (q,) values.
    covariance
        (q, q) covariance.
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray

    @property
    def standard_deviation(self) -> FloatArray:
        """(q,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def rows(self) -> list[tuple[str, float, float]]:
        """Name, value and standard deviation of each parameter."""
        return list(zip(self.names, self.values.tolist(), self.standard_deviation.tolist(), strict=True))

    def value(self, name: str) -> float:
        """Return one parameter; raise KeyError if it does not exist."""
        return float(self.values[self._index(name)])

    def deviation(self, name: str) -> float:
        """Return the standard deviation of one parameter; raise KeyError if it does not exist."""
        return float(self.standard_deviation[self._index(name)])

    def slope(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the derivatives (r, q) of a function from (q,) to (r,) at the parameters."""
        slopes = []
        for i, value in enumerate(self.values):
            step = _STEP * max(abs(value), 1e-3) * np.eye(len(self.values))[i]
            slopes.append((function(self.values + step) - function(self.values - step)) / (2 * step[i]))
        return np.array(slopes).T

    def derived(self, names: Sequence[str], function: Callable[[FloatArray], FloatArray]) -> ParameterEstimate:
        """Apply a function from (q,) to (r,) to the parameters; propagate the covariance to first order."""
        slope = self.slope(function)
        return ParameterEstimate(tuple(names), np.asarray(function(self.values)), slope @ self.covariance @ slope.T)

    def part(self, names: Sequence[str]) -> ParameterEstimate:
        """Return the estimate of the parameters `names`; raise KeyError if a name does not exist."""
        rows = [self._index(name) for name in names]
        return ParameterEstimate(tuple(names), self.values[rows], self.covariance[np.ix_(rows, rows)])

    def renamed(self, prefix: str) -> ParameterEstimate:
        """Return the parameters with `prefix` and a dot before their names."""
        return ParameterEstimate(tuple(f"{prefix}.{name}" for name in self.names), self.values, self.covariance)

    def _index(self, name: str) -> int:
        if name not in self.names:
            raise KeyError(f"no parameter '{name}'; the parameters are {', '.join(self.names)}")
        return self.names.index(name)


def join_estimates(estimates: Sequence[ParameterEstimate]) -> ParameterEstimate:
    """Concatenate independent estimates."""
    return ParameterEstimate(
        tuple(name for estimate in estimates for name in estimate.names),
        np.concatenate([estimate.values for estimate in estimates]),
        linalg.block_diag(*(estimate.covariance for estimate in estimates)),
    )


# Parameter vectors: parametrisation of the matrices, dead times, sensor offsets and input limits.


class Parametrisation(Protocol):
    """Map from parameters (s,) to the matrices A, B and C."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each parameter."""
        ...

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(s,) lower and upper bounds."""
        ...

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return A (n, n), B (n, m), C (p, n) for parameters (s,).

        The map must be analytic for complex-step differentiation.
        """
        ...

    def recentred(self, parameters: FloatArray) -> tuple[Parametrisation, FloatArray]:
        """Return a parametrisation with its origin near `parameters`, and `parameters` in its coordinates."""
        ...


@dataclass(frozen=True)
class Layout:
    """Layout of parameters (q,) in the order parametrisation, dead times [s], output offsets, input limits.

    Attributes
    ----------
    parametrisation
        Parametrisation of A, B and C.
    inputs, outputs
        Numbers m and p of inputs and outputs.
    known_dead_time
        Fixed dead time of all inputs [s]; None to estimate one per input.
    offset
        (p,) True for outputs with a constant sensor bias that is estimated.
    limited
        (m, 4) True for limits of inputs that are estimated, in the order of `input_limits.KINDS`.
    """

    parametrisation: Parametrisation
    inputs: int
    outputs: int
    known_dead_time: float | None = None
    offset: tuple[bool, ...] = ()
    limited: tuple[tuple[bool, ...], ...] = ()

    def __post_init__(self) -> None:
        """Replace missing masks by masks without offsets and limits."""
        object.__setattr__(self, "offset", self.offset or (False,) * self.outputs)
        object.__setattr__(self, "limited", self.limited or ((False,) * len(KINDS),) * self.inputs)

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Numbers of parameters of the parametrisation, dead times, offsets and limits."""
        return len(self.parametrisation.names), len(self._dead_times), sum(self.offset), sum(map(sum, self.limited))

    @property
    def names(self) -> tuple[str, ...]:
        """(q,) names; dead times, offsets and limits have the index of their input or output."""
        offsets = [f"offset_{i}" for i, free in enumerate(self.offset) if free]
        limits = [f"{kind}_{j}" for j, free in enumerate(self.limited) for kind in compress(KINDS, free)]
        return (*self.parametrisation.names, *self._dead_times, *offsets, *limits)

    @property
    def _dead_times(self) -> tuple[str, ...]:
        return () if self.known_dead_time is not None else tuple(f"dead_time_{j}" for j in range(self.inputs))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(q,) lower and upper bounds."""
        _, dead_times, offsets, limits = self.counts
        low, high = self.parametrisation.bounds
        max_dead_time = estimator_settings().max_dead_time
        return (
            np.concatenate([low, np.zeros(dead_times), np.full(offsets, -np.inf), np.full(limits, 1e-6)]),
            np.concatenate(
                [high, np.full(dead_times, max_dead_time), np.full(offsets, np.inf), np.full(limits, _MAX_LIMIT)]
            ),
        )

    def around(self, parametrisation: Parametrisation) -> Layout:
        """Return the layout with another parametrisation."""
        return replace(self, parametrisation=parametrisation)

    def split(self, parameters: AnyArray) -> list[AnyArray]:
        """Split `parameters` (q,) into parametrisation, dead times, offsets and limits."""
        return list(np.split(parameters, np.cumsum(self.counts)[:-1]))

    def system(self, parameters: AnyArray) -> LinearSystem:
        """Return the system with `parameters` (q,)."""
        coordinates, dead_time, offsets, limits = self.split(parameters)
        if self.known_dead_time is not None:
            dead_time = np.array([self.known_dead_time])
        offset = np.zeros(self.outputs, dtype=parameters.dtype)
        offset[np.array(self.offset)] = offsets
        limit = np.full((self.inputs, len(KINDS)), np.inf, dtype=parameters.dtype)
        limit[np.array(self.limited)] = limits
        A, B, C = self.parametrisation.matrices(coordinates)
        return LinearSystem(A, B, C, np.broadcast_to(dead_time, self.inputs), offset, limit)
