"""Backend solvers of the condensed problem, in addition to the core's own: one interface, and the loop that asks them.

A backend is given only the kinds of limit that matter: those that pressed at the last tick or that the minimiser
without limits breaks. If its solution keeps all others it solves the whole problem; if not, the broken kinds are added
and it solves again.
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
"""Some of the kinds of limit, ascending: v_ref, omega_ref, their increments, and from `HARD` on the soft ones."""
SHORTEST = 1e-9
"""Time limit of a solver whose time is over [s]; OSQP refuses 0, and DAQP takes it for none."""


class Program:
    """The tick's quadratic program in the core's memory, without a copy.

    Minimise U'HU/2 + g'U + penalty(soft rows) subject to lower <= values(U) <= upper, U the commands step by step.

    Attributes
    ----------
    H, g
        (2 N, 2 N), (2 N,).
    lower, upper
        (kinds, N) bounds of the commands, of their increments (the first counts from zero) and of the soft limits.
    guess
        (2 N,) a plan near the solution.
    multipliers
        (kinds, N) of the limits near the solution: positive at upper bounds, negative at lower ones, else zero.
    last_command, aim, feed_forward, fed_before
        (2,) the command that the first increment counts from; (N + 1, 4) poses to aim at and headings to hold; (N, 2)
        commands from which deviations are penalised; (2,) that of the last tick.
    late
        (2,) delays that the plan reckons with [samples].
    ahead
        (N,) how far ahead of its origin the robot turns on each arc [m], along the guess.
    soft_values
        (kinds - 4, N) soft values at a plan of zeros, to first order; soft bounds are less this.
    kinds
        The kinds that pressed last, or that the minimiser without limits breaks.
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
        self.soft_values, self._pressing = tick.view(c.soft_value, (kinds - HARD, steps)), c.pressing
        self._missed = tick.ffi.new("int[]", kinds)

    @property
    def kinds(self) -> Kinds:
        """See the class."""
        return tuple(kind for kind in range(self._count) if self._pressing[kind])

    @property
    def soft_limits(self) -> FloatArray:
        """(kinds - 4,) upper limits of the soft kinds at this tick, in their own units."""
        return self.upper[HARD:, 0] + self.soft_values[:, 0]

    def count_from(self, command: FloatArray) -> None:
        """Let slew count from `command` (2,) at the next tick: for a controller that looks on while another drives."""
        self._tick.view(self._tick.lib.ddmpc_last_command(self._tick.c), (2,))[:] = command

    def linearise(self, plan: FloatArray) -> None:
        """Linearise the last tick's problem along `plan` (2 N,) instead; the next tick does not depend on that."""
        self._tick.lib.ddmpc_linearise_again(self._tick.c, self._tick.ffi.from_buffer("real[]", plan))

    @property
    def directions(self) -> FloatArray:
        """(2, N) directions of travel, 1 or -1, of the body at the end of each step and of its command."""
        values, tick = np.empty((2, self._steps)), self._tick
        tick.lib.ddmpc_directions(tick.c, tick.ffi.from_buffer("real[]", values))
        return values

    def rows(self, kind: int) -> FloatArray:
        """Return the (N, 2 N) rows of one kind of soft limit."""
        rows, tick = np.empty((self._steps, 2 * self._steps)), self._tick
        tick.lib.ddmpc_soft_rows(tick.c, kind, tick.ffi.cast("real *", rows.ctypes.data))
        return rows

    def broken(self, plan: FloatArray, margin: float) -> Kinds:
        """Return the kinds that `plan` (2 N,) exceeds somewhere by more than `margin`."""
        tick = self._tick
        values = tick.ffi.from_buffer("real[]", np.ascontiguousarray(plan))
        tick.lib.ddmpc_broken(tick.c, values, margin, self._missed)
        return tuple(kind for kind, missed in enumerate(self._missed) if missed)


class Solved(NamedTuple):
    """Result of a backend.

    Attributes
    ----------
    plan
        (2 N,) plan; valid only if the status is usable.
    multipliers
        (kinds, N) of the limits, zero where a limit is inactive.
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
    """A solver with its work space. It never raises on numbers."""

    def __init__(self, steps: int, kinds: int, settings: Solver, weights: Weights) -> None: ...

    def solve(
        self,
        program: Program,
        kinds: Kinds,
        guess: FloatArray,
        multipliers: FloatArray,
        time_limit: float | None = None,
    ) -> Solved:
        """Solve with these kinds of limit, from a plan (2 N,) and multipliers (kinds, N) near the solution.

        With `time_limit` it ends after that time [s], and does not start if its factorisation is expected to take
        longer.
        """
        ...


class SetUpTime:
    """Processor time of work that a time limit does not interrupt, such as a factorisation.

    The shortest measurement counts: a single late one must not disable the solver forever. Time of other processes does
    not count.
    """

    def __init__(self) -> None:
        self._per_unit = math.inf

    def expected(self, size: float = 1.0) -> float:
        """Return the time that work of this size needs [s]; 0 without a measurement."""
        return 0.0 if math.isinf(self._per_unit) else size * self._per_unit

    @contextmanager
    def measured(self, size: float = 1.0) -> Iterator[None]:
        """Measure the enclosed work, which has this size."""
        began = time.thread_time()
        yield
        self._per_unit = min(self._per_unit, (time.thread_time() - began) / size)


def ask(
    backend: Backend, program: Program, path: str, slack: float, deadline: float | None = None
) -> tuple[Solved, SolverReport]:
    """Solve the whole problem with a backend named `path`; `slack` is the tolerated violation of a limit.

    It ends at `deadline`, by `time.monotonic` [s]; a solve that could not end by then is not begun.
    """
    kinds = tuple(sorted({*range(HARD), *program.kinds}))
    guess, multipliers, iterations = program.guess, program.multipliers, 0
    while True:
        left = None if deadline is None else deadline - time.monotonic()
        if left is not None and not left > 0.0:  # for NaN, too
            solved = Solved(guess, multipliers, SolverStatus.TIME_LIMIT)
            break
        solved = backend.solve(program, kinds, guess, multipliers, left)
        iterations += solved.iterations
        if not np.isfinite(solved.plan).all():
            solved = solved._replace(status=SolverStatus.NOT_FINITE)
        missed = program.broken(solved.plan, slack) if solved.status.usable else ()
        if set(missed) <= set(kinds):
            break
        kinds = tuple(sorted({*kinds, *missed}))
        guess, multipliers = solved.plan, solved.multipliers
    soft = any(kind >= HARD for kind in kinds)
    return solved, SolverReport(
        solved.status, path, iterations, solved.primal_residual, solved.dual_residual, soft_limits=soft
    )


# Available solvers, by their names in the configuration (`solver.method`).


BACKENDS: Mapping[str, str] = {"daqp": "DaqpBackend", "osqp": "OsqpBackend"}
"""Class of each backend; its module is `mpc.solver.NAME_backend`."""


def load_backend(name: str) -> type[Backend]:
    """Import the backend `name`: a solver's library is loaded only where the configuration names it."""
    backend: type[Backend] = getattr(import_module(f"{__package__}.{name}_backend"), BACKENDS[name])
    return backend
