"""Interface of backend solvers for the condensed problem, and loop that adds violated limits.

A backend first solves the problem with the kinds of limits that were active at the last tick or that the unconstrained
minimiser violates. If the solution satisfies all other limits, it is the solution of the full problem. Otherwise the
violated kinds are added, and the backend solves again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import NamedTuple, Protocol

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.core.tick import Tick
from diffdrive_mpc.mpc.problem.constants import HARD_KINDS as HARD
from diffdrive_mpc.mpc.solver.report import SolverReport, SolverStatus

Kinds = tuple[int, ...]
"""Ascending kinds of limits: v_ref, omega_ref, their increments, and from `HARD` on the soft limits."""
MIN_TIME_LIMIT = 1e-9
"""Lower bound of the time limit of a solver [s]; OSQP rejects 0, and DAQP treats 0 as no limit."""


class Program:
    """Quadratic program of a tick; the arrays are views of the core's memory.

    Minimise U'HU/2 + g'U + penalty(soft rows) subject to lower <= values(U) <= upper, where U contains the commands
    step by step.

    Attributes
    ----------
    H, g
        Hessian (2 N, 2 N) and gradient (2 N,).
    lower, upper
        (kinds, N) bounds of the commands, of their increments (the first increment relative to zero) and of the
        soft-limited values.
    guess
        (2 N,) initial guess of the plan.
    multipliers
        (kinds, N) initial guess of the multipliers: positive at upper bounds, negative at lower bounds, else zero.
    last_command, aim, feed_forward, fed_before
        (2,) command before the first increment; (N + 1, 4) target poses and target headings; (N, 2) commands whose
        deviations are penalised; (2,) feed-forward command of the last tick.
    late
        (2,) delays of the commands in the plan [samples].
    ahead
        (N,) distance of the turning point ahead of the origin on each arc [m], along the guess.
    soft_values
        (kinds - 4, N) first-order values of the soft limits at a zero plan, which are subtracted from the bounds.
    kinds
        Kinds of limits that were active at the last tick, or that the unconstrained minimiser violates.
    """

    def __init__(self, tick: Tick, steps: int, kinds: int) -> None:
        c, n = tick.lib.ddmpc_program_of(tick.c), 2 * steps
        self._tick, self._steps, self._count = tick, steps, kinds
        self.H, self.g = tick.view(c.H, (n, n)), tick.view(c.g, (n,))
        self.lower, self.upper = tick.view(c.lower, (kinds, steps)), tick.view(c.upper, (kinds, steps))
        self.guess, self.multipliers = tick.view(c.guess, (n,)), tick.view(c.multipliers, (kinds, steps))
        self.last_command, self.aim = tick.view(c.last_command, (2,)), tick.view(c.aim, (steps + 1, 4))
        self.feed_forward, self.ahead = tick.view(c.feed_forward, (steps, 2)), tick.view(c.ahead, (steps,))
        self.fed_before, self.late = tick.view(c.fed_before, (2,)), tick.view(c.late, (2,))
        self.soft_values, self._active = tick.view(c.soft_value, (kinds - HARD, steps)), c.active_kinds
        self._violated = tick.ffi.new("int[]", kinds)

    @property
    def kinds(self) -> Kinds:
        """Kinds of limits that were active at the last tick, or that the unconstrained minimiser violates."""
        return tuple(kind for kind in range(self._count) if self._active[kind])

    @property
    def soft_limits(self) -> FloatArray:
        """(kinds - 4,) upper soft limits at this tick, in the units of the limited values."""
        return self.upper[HARD:, 0] + self.soft_values[:, 0]

    def count_from(self, command: FloatArray) -> None:
        """Set the last command (2,); used if another controller drives the robot."""
        self._tick.view(self._tick.lib.ddmpc_last_command(self._tick.c), (2,))[:] = command

    def linearise(self, plan: FloatArray) -> None:
        """Linearise the problem of the last tick along `plan` (2 N,); the next tick is not affected."""
        self._tick.lib.ddmpc_linearise_again(self._tick.c, self._tick.ffi.from_buffer("real[]", plan))

    @property
    def directions(self) -> FloatArray:
        """(2, N) directions of travel, 1 or -1, of the body at the end of each step and of the command of the step."""
        values, tick = np.empty((2, self._steps)), self._tick
        tick.lib.ddmpc_directions(tick.c, tick.ffi.from_buffer("real[]", values))
        return values

    def rows(self, kind: int) -> FloatArray:
        """Return the rows (N, 2 N) of the soft limit `kind`."""
        rows, tick = np.empty((self._steps, 2 * self._steps)), self._tick
        tick.lib.ddmpc_soft_rows(tick.c, kind, tick.ffi.cast("real *", rows.ctypes.data))
        return rows

    def violated_kinds(self, plan: FloatArray, margin: float) -> Kinds:
        """Return the kinds of limits that `plan` (2 N,) violates by more than `margin` at any step."""
        tick = self._tick
        values = tick.ffi.from_buffer("real[]", np.ascontiguousarray(plan))
        tick.lib.ddmpc_violated_kinds(tick.c, values, margin, self._violated)
        return tuple(kind for kind, is_violated in enumerate(self._violated) if is_violated)


class Solved(NamedTuple):
    """Result of a backend.

    Attributes
    ----------
    plan
        (2 N,) plan; valid only if `status.usable` is True.
    multipliers
        (kinds, N) multipliers of the limits; zero for inactive limits.
    status, iterations, primal_residual, dual_residual
        Report of the solver.
    """

    plan: FloatArray
    multipliers: FloatArray
    status: SolverStatus
    iterations: int = 0
    primal_residual: float = float("nan")
    dual_residual: float = float("nan")


class Backend(Protocol):
    """Solver with its work space; invalid numbers result in a status, not in an error."""

    def __init__(self, steps: int, kinds: int, settings: Solver, weights: Weights) -> None: ...

    def solve(
        self,
        program: Program,
        kinds: Kinds,
        guess: FloatArray,
        multipliers: FloatArray,
        time_limit: float | None = None,
    ) -> Solved:
        """Solve the program with the limits `kinds`, warm-started from a plan (2 N,) and multipliers (kinds, N).

        The solver stops after `time_limit` [s], and does not start if its factorisation is expected to exceed this
        limit.
        """
        ...


class SetUpTime:
    """Estimate of the processor time of a computation that cannot be interrupted, such as a factorisation.

    The estimate is the minimum of all measurements, so that an outlier does not disable the solver permanently. The
    time of other threads is excluded.
    """

    def __init__(self) -> None:
        self._per_unit = math.inf

    def expected(self, size: float = 1.0) -> float:
        """Return the expected time [s] of a computation of the given size; 0 before the first measurement."""
        return 0.0 if math.isinf(self._per_unit) else size * self._per_unit

    @contextmanager
    def measured(self, size: float = 1.0) -> Iterator[None]:
        """Measure the time of the `with` block, a computation of the given size."""
        start = time.thread_time()
        yield
        self._per_unit = min(self._per_unit, (time.thread_time() - start) / size)


def solve_all(
    backend: Backend, program: Program, method: str, slack: float, deadline: float | None = None
) -> tuple[Solved, SolverReport]:
    """Solve the full problem with `backend`; `slack` is the excess up to which a limit counts as satisfied.

    `method` is the name of the backend in the report. The solve stops at `deadline` [s, `time.monotonic`], and does not
    start if it is not expected to end in time.
    """
    kinds = tuple(sorted({*range(HARD), *program.kinds}))
    guess, multipliers, iterations = program.guess, program.multipliers, 0
    while True:
        remaining = None if deadline is None else deadline - time.monotonic()
        if remaining is not None and not remaining > 0.0:  # negated so that NaN counts as expired
            solution = Solved(guess, multipliers, SolverStatus.TIME_LIMIT)
            break
        solution = backend.solve(program, kinds, guess, multipliers, remaining)
        iterations += solution.iterations
        if not np.isfinite(solution.plan).all():
            solution = solution._replace(status=SolverStatus.NOT_FINITE)
        violated = program.violated_kinds(solution.plan, slack) if solution.status.usable else ()
        if set(violated) <= set(kinds):
            break
        # Each iteration adds at least one kind, so the loop terminates.
        kinds = tuple(sorted({*kinds, *violated}))
        guess, multipliers = solution.plan, solution.multipliers
    soft = any(kind >= HARD for kind in kinds)
    return solution, SolverReport(
        solution.status, method, iterations, solution.primal_residual, solution.dual_residual, soft_limits=soft
    )


BACKENDS: Mapping[str, str] = {"daqp": "DaqpBackend", "osqp": "OsqpBackend"}
"""Class of each backend by its name in the configuration (`solver.method`); the module is `mpc.solver.NAME_backend`."""


def load_backend(name: str) -> type[Backend]:
    """Import the backend `name`, and with it the library of its solver."""
    backend: type[Backend] = getattr(import_module(f"{__package__}.{name}_backend"), BACKENDS[name])
    return backend
