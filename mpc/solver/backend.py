"""Backend solvers of the condensed problem, in addition to the core's methods: their interface and the solve loop.

A backend is first given only the kinds of limit that were active at the last tick or that the unconstrained minimiser
violates. If its solution satisfies all other limits, it solves the full problem; if not, the violated kinds are added
and the backend solves again.
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
"""Kinds of limit, ascending: v_ref, omega_ref, their increments, and from `HARD` on the soft limits."""
MIN_TIME_LIMIT = 1e-9
"""Time limit passed to a solver if no time is left [s]; OSQP rejects 0, and DAQP treats 0 as no limit."""


class Program:
    """The tick's quadratic program in the core's memory, without a copy.

    Minimise U'HU/2 + g'U + penalty(soft rows) subject to lower <= values(U) <= upper; U are the commands step by step.

    Attributes
    ----------
    H, g
        (2 N, 2 N), (2 N,).
    lower, upper
        (kinds, N) bounds of the commands, of their increments (the first one relative to zero) and of the soft limits.
    guess
        (2 N,) initial guess of the plan.
    multipliers
        (kinds, N) initial guess of the multipliers: positive at upper bounds, negative at lower bounds, else zero.
    last_command, aim, feed_forward, fed_before
        (2,) command before the first increment; (N + 1, 4) target poses and headings to hold; (N, 2) commands from
        which deviations are penalised; (2,) feed-forward command of the last tick.
    late
        (2,) delays that the plan accounts for [samples].
    ahead
        (N,) distance of the turning point ahead of the origin on each arc [m], along the guess.
    soft_values
        (kinds - 4, N) soft values at a plan of zeros, to first order; they are subtracted from the soft bounds.
    kinds
        Kinds of limit that were active at the last tick, or that the unconstrained minimiser violates.
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
        """Kinds of limit that were active at the last tick, or that the unconstrained minimiser violates."""
        return tuple(kind for kind in range(self._count) if self._active[kind])

    @property
    def soft_limits(self) -> FloatArray:
        """(kinds - 4,) upper limits of the soft kinds at this tick, in the units of the limited values."""
        return self.upper[HARD:, 0] + self.soft_values[:, 0]

    def count_from(self, command: FloatArray) -> None:
        """Set the command (2,) before the next tick, for a controller that runs while another one drives."""
        self._tick.view(self._tick.lib.ddmpc_last_command(self._tick.c), (2,))[:] = command

    def linearise(self, plan: FloatArray) -> None:
        """Linearise the last tick's problem along `plan` (2 N,); the next tick is not affected."""
        self._tick.lib.ddmpc_linearise_again(self._tick.c, self._tick.ffi.from_buffer("real[]", plan))

    @property
    def directions(self) -> FloatArray:
        """(2, N) directions of travel, 1 or -1: of the body at the end of each step, and of the step's command."""
        values, tick = np.empty((2, self._steps)), self._tick
        tick.lib.ddmpc_directions(tick.c, tick.ffi.from_buffer("real[]", values))
        return values

    def rows(self, kind: int) -> FloatArray:
        """Return the (N, 2 N) rows of one kind of soft limit."""
        rows, tick = np.empty((self._steps, 2 * self._steps)), self._tick
        tick.lib.ddmpc_soft_rows(tick.c, kind, tick.ffi.cast("real *", rows.ctypes.data))
        return rows

    def violated_kinds(self, plan: FloatArray, margin: float) -> Kinds:
        """Return the kinds of limit that `plan` (2 N,) violates at any step by more than `margin`."""
        tick = self._tick
        values = tick.ffi.from_buffer("real[]", np.ascontiguousarray(plan))
        tick.lib.ddmpc_violated_kinds(tick.c, values, margin, self._violated)
        return tuple(kind for kind, is_violated in enumerate(self._violated) if is_violated)


class Solved(NamedTuple):
    """Result of a backend.

    Attributes
    ----------
    plan
        (2 N,) plan; valid only if the status is usable.
    multipliers
        (kinds, N) multipliers of the limits, zero if inactive.
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
    """A solver with its work space. It does not raise on invalid numbers; it returns a status."""

    def __init__(self, steps: int, kinds: int, settings: Solver, weights: Weights) -> None: ...

    def solve(
        self,
        program: Program,
        kinds: Kinds,
        guess: FloatArray,
        multipliers: FloatArray,
        time_limit: float | None = None,
    ) -> Solved:
        """Solve with these kinds of limit, warm-started from a plan (2 N,) and multipliers (kinds, N).

        The solver stops after `time_limit` [s], and does not start if the factorisation is expected to take longer.
        """
        ...


class SetUpTime:
    """Processor time of work that a time limit cannot interrupt, such as a factorisation.

    The shortest measurement is used, so that a single outlier does not disable the solver forever. Time of other
    processes is excluded.
    """

    def __init__(self) -> None:
        self._per_unit = math.inf

    def expected(self, size: float = 1.0) -> float:
        """Return the expected time of work of this size [s]; 0 before the first measurement."""
        return 0.0 if math.isinf(self._per_unit) else size * self._per_unit

    @contextmanager
    def measured(self, size: float = 1.0) -> Iterator[None]:
        """Measure the enclosed work, which has this size."""
        start = time.thread_time()
        yield
        self._per_unit = min(self._per_unit, (time.thread_time() - start) / size)


def solve_all(
    backend: Backend, program: Program, method: str, slack: float, deadline: float | None = None
) -> tuple[Solved, SolverReport]:
    """Solve the full problem with `backend`; `slack` is the tolerated violation of a limit.

    `method` is the backend's name in the report. The solve ends at `deadline` [s, `time.monotonic`]; a solve that is
    not expected to end in time is not started.
    """
    kinds = tuple(sorted({*range(HARD), *program.kinds}))
    guess, multipliers, iterations = program.guess, program.multipliers, 0
    while True:
        left = None if deadline is None else deadline - time.monotonic()
        if left is not None and not left > 0.0:  # also true if the deadline is NaN
            solved = Solved(guess, multipliers, SolverStatus.TIME_LIMIT)
            break
        solved = backend.solve(program, kinds, guess, multipliers, left)
        iterations += solved.iterations
        if not np.isfinite(solved.plan).all():
            solved = solved._replace(status=SolverStatus.NOT_FINITE)
        violated = program.violated_kinds(solved.plan, slack) if solved.status.usable else ()
        if set(violated) <= set(kinds):
            break
        kinds = tuple(sorted({*kinds, *violated}))
        guess, multipliers = solved.plan, solved.multipliers
    soft = any(kind >= HARD for kind in kinds)
    return solved, SolverReport(
        solved.status, method, iterations, solved.primal_residual, solved.dual_residual, soft_limits=soft
    )


# Available solvers, by their names in the configuration (`solver.method`).


BACKENDS: Mapping[str, str] = {"daqp": "DaqpBackend", "osqp": "OsqpBackend"}
"""Class of each backend; its module is `mpc.solver.NAME_backend`."""


def load_backend(name: str) -> type[Backend]:
    """Import the backend `name`; a solver's library is loaded only if the configuration selects it."""
    backend: type[Backend] = getattr(import_module(f"{__package__}.{name}_backend"), BACKENDS[name])
    return backend
