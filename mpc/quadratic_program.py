"""The condensed quadratic program, as its solvers see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.solver_report import SolverStatus

Kinds = tuple[int, ...]
"""Some of the kinds of limit, ascending: v_ref, omega_ref, their increments, and from 4 on the kinds of `soft`."""


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Minimiser of U'HU/2 + g'U, and the factor of H = L L' that gave it.

    Attributes
    ----------
    plan
        (2 N,) the minimiser.
    factor
        (2 N, 2 N) L, lower triangular, columns contiguous.
    residual
        Largest entry of |H plan + g|.
    broken
        Kinds of limit that `plan` breaks; where it breaks none it solves the whole problem.
    """

    plan: FloatArray
    factor: FloatArray
    residual: float
    broken: Kinds


class Found(NamedTuple):
    """The solution of a least-distance problem in terms of the commands.

    Attributes
    ----------
    plan
        (2 N,) the commands.
    excess, residual
        By how much the worst hard limit is exceeded, and how far the cost is from stationary.
    multipliers
        (9, N) of all kinds of limit: positive at upper bounds, negative at lower ones, else zero.
    kinds
        The kinds that press somewhere.
    """

    plan: FloatArray
    excess: float
    residual: float
    multipliers: FloatArray
    kinds: Kinds


class LeastDistance(Protocol):
    """Minimise |z|^2 / 2 subject to lower <= rows z <= upper, soft limits at their price; (kinds N) rows by kind."""

    @property
    def rows(self) -> FloatArray:
        """(kinds N, 2 N) rows of the limits."""
        ...

    @property
    def lower(self) -> FloatArray:
        """(kinds N,) lower bounds."""
        ...

    @property
    def upper(self) -> FloatArray:
        """(kinds N,) upper bounds."""
        ...

    def flags(self, multipliers: FloatArray, price: float) -> NDArray[np.intc]:
        """(kinds N,) how rows begin where a solution with `multipliers` (9, N) is near, as DAQP numbers it.

        `price` is that of each unit beyond a soft limit.
        """
        ...

    def found(self, z: FloatArray, pressing: FloatArray) -> Found:
        """What the solution z (2 N,) is, on which the rows press with `pressing` (kinds N,)."""
        ...


class QuadraticProgram(Protocol):
    """Minimise U'HU/2 + g'U + penalty(soft U) subject to |U| <= box and |increments| <= slew.

    U are the commands of N steps, flat (2 N,). It is valid until the next one is condensed.
    """

    @property
    def H(self) -> FloatArray:  # noqa: N802 - the letter of the field
        """(2 N, 2 N) Gauss-Newton Hessian."""
        ...

    @property
    def g(self) -> FloatArray:
        """(2 N,) gradient at U = 0."""
        ...

    @property
    def box(self) -> FloatArray:
        """(2 N,) bound of each command."""
        ...

    @property
    def slew(self) -> FloatArray:
        """(2,) bound of each increment."""
        ...

    @property
    def last_command(self) -> FloatArray:
        """(2,) the command before the first."""
        ...

    @property
    def soft(self) -> FloatArray:
        """(5, N, 2 N) rows of what should stay inside, at a price, over the steps 1 to N.

        The kinds are v, omega, right and left wheel speed, distance across the path.
        """
        ...

    @property
    def soft_lower(self) -> FloatArray:
        """(5, N) lower bounds of these rows."""
        ...

    @property
    def soft_upper(self) -> FloatArray:
        """(5, N) upper bounds of these rows."""
        ...

    def soft_values(self, plan: FloatArray) -> FloatArray:
        """(5, N) the soft rows at the flat `plan` (2 N,)."""
        ...

    def soft_rows(self, kind: int) -> FloatArray:
        """(N, 2 N) the soft rows of one kind."""
        ...

    def relax(self) -> Relaxed | SolverStatus:
        """The minimiser without limits, or what keeps it from being found."""
        ...

    def broken(self, plan: FloatArray, slack: float) -> Kinds:
        """Kinds of limit that the flat `plan` (2 N,) exceeds somewhere by more than `slack`."""
        ...

    def least_distance(self, relaxed: Relaxed, kinds: Kinds) -> LeastDistance:
        """The same problem with these kinds of limit as a least-distance problem about the minimiser `relaxed`."""
        ...
