"""Quadratic program of a tick in the standard form of QP solvers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS as HARD
from diffdrive_mpc.mpc.solver.backend import Program

_HARD_NAMES = ("v", "omega", "v_increment", "omega_increment")


class QuadraticProgram(NamedTuple):
    """Quadratic program: minimise x'Px/2 + q'x subject to l <= A x <= u.

    The first 2 N variables are the commands v [m/s], omega [rad/s], step by step. They are followed by the slacks of
    the soft limits: violations of the upper limits (`over`), then violations of the lower limits (`under`).

    Attributes
    ----------
    P, q
        Symmetric Hessian (n, n), and linear term (n,).
    A
        Constraint matrix (m, n).
    l, u
        (m,) bounds; infinite if there is no bound. Increments of the first step are relative to zero, and their bounds
        include the previous command. Soft limits apply to the difference of the values from the values at a zero plan.
    variables, rows
        Names (n,) and (m,) with the index of the step, such as `v[3]` and `soft omega[3]`.
    """

    P: sparse.csc_matrix
    q: FloatArray
    A: sparse.csc_matrix
    l: FloatArray  # noqa: E741 - usual name in QP solvers
    u: FloatArray
    variables: tuple[str, ...]
    rows: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the sizes, without the arrays."""
        return f"QuadraticProgram of {len(self.q)} variables, {len(self.rows)} rows: P, q, A, l, u, variables, rows"


def quadratic_program(program: Program, weights: Weights, soft_names: Sequence[str]) -> QuadraticProgram:
    """Copy the program of a tick with all limits.

    Parameters
    ----------
    program
        Quadratic program of the controller.
    weights
        Penalty weights of the slacks.
    soft_names
        (kinds - 4,) names of the soft limits.
    """
    steps, n = len(program.feed_forward), len(program.g)
    channels = [sparse.identity(n, format="csr")[i::2] for i in (0, 1)]
    difference = sparse.identity(steps) - sparse.eye(steps, k=-1)
    hard = sparse.vstack([*channels, *(difference @ channel for channel in channels)])
    soft = np.concatenate([program.rows(HARD + kind) for kind in range(len(soft_names))])
    slack, upper = sparse.identity(len(soft)), np.triu(program.H)
    price = weights.soft_quadratic * sparse.identity(2 * len(soft))
    kinds = [*_HARD_NAMES, *(f"soft {name}" for name in soft_names)]
    values = [f"{kind}[{step}]" for kind in kinds for step in range(steps)]
    slacks = [f"{side} {value}" for side in ("over", "under") for value in values[HARD * steps :]]
    return QuadraticProgram(
        P=sparse.block_diag([upper + np.triu(upper, 1).T, price], format="csc"),
        q=np.concatenate([program.g, np.full(2 * len(soft), weights.soft)]),
        A=sparse.bmat([[hard, None, None], [soft, -slack, slack], [None, slack, None], [None, None, slack]], "csc"),
        l=np.concatenate([program.lower.reshape(-1), np.zeros(2 * len(soft))]),
        u=np.concatenate([program.upper.reshape(-1), np.full(2 * len(soft), np.inf)]),
        variables=(*(f"{channel}[{step}]" for step in range(steps) for channel in _HARD_NAMES[:2]), *slacks),
        rows=(*values, *slacks),
    )
