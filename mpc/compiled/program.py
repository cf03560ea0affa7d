"""The condensed quadratic program on the memory of C."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.compiled.least_distance import CompiledLeastDistance, from_bits
from diffdrive_mpc.mpc.compiled.library import bound_function, callable_in, checked_size, pointer
from diffdrive_mpc.mpc.quadratic_program import Kinds, Relaxed
from diffdrive_mpc.mpc.solver_report import SolverStatus

# By the values of ddmpc_relax_status.
_FAULTS = {1: SolverStatus.NOT_FINITE, 2: SolverStatus.NOT_CONVEX}


class CompiledProgram:
    """Implements `mpc.quadratic_program.QuadraticProgram` on the memory of C; rows are written where asked for.

    Its minimiser without limits is found with it, in the same call.

    Parameters
    ----------
    library
        The compiled sources.
    data, slew, last_command
        The fields of ddmpc_qp, and what the program has beside them.
    constants, tick, plan, work, qp
        Addresses of the C structs, and of the plan that is linearised along.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        data: Mapping[str, FloatArray],
        slew: FloatArray,
        last_command: FloatArray,
        constants: ctypes.c_void_p,
        tick: ctypes.c_void_p,
        plan: ctypes.c_void_p,
        work: ctypes.c_void_p,
        qp: ctypes.c_void_p,
    ) -> None:
        self.H, self.g, self.box = data["H"], data["g"], data["box"]
        self.soft_lower, self.soft_upper = data["soft_lower"], data["soft_upper"]
        self.slew, self.last_command = slew, last_command
        n, (kinds, steps) = len(self.g), self.soft_lower.shape
        self._plan, self._values, self._rows = np.zeros(n), np.zeros((kinds, steps)), np.zeros((steps, n))
        own_plan, values, rows = pointer(self._plan), pointer(self._values), pointer(self._rows)
        self._relaxed, self._bits = np.zeros(checked_size(library, "ddmpc_relaxed_size") // 8), ctypes.c_int()
        self._factor = self._relaxed[n + 1 : n + 1 + n * n].reshape(n, n).T
        self._minimiser = self._relaxed[:n]
        self._status = 0

        address, relaxed, bits = ctypes.c_void_p, pointer(self._relaxed), ctypes.byref(self._bits)
        fill = callable_in(library, "ddmpc_condense_and_relax", ctypes.c_int, *(address,) * 7)
        self._fill: Callable[[], int] = lambda: fill(constants, tick, plan, work, qp, relaxed, bits)
        self._write_values = bound_function(library, "ddmpc_soft_values", constants, tick, work, own_plan, values)
        write = callable_in(library, "ddmpc_soft_rows", None, address, address, address, ctypes.c_int, address)
        self._write_rows: Callable[[int], None] = lambda kind: write(constants, tick, work, kind, rows)
        self._least_distance = CompiledLeastDistance(library, n, constants, tick, work, qp, relaxed)
        check = callable_in(library, "ddmpc_broken", ctypes.c_int, *(address,) * 5, ctypes.c_double)
        self._broken: Callable[[float], int] = lambda slack: check(constants, tick, work, qp, own_plan, slack)

    def fill(self) -> None:
        """Condense the tick along the plan, both as they are in memory now."""
        self._status = self._fill()

    @property
    def soft(self) -> FloatArray:
        """See `QuadraticProgram`."""
        return np.stack([self.soft_rows(kind) for kind in range(len(self._values))])

    def soft_values(self, plan: FloatArray) -> FloatArray:
        """See `QuadraticProgram`."""
        self._plan[:] = plan
        self._write_values()
        return self._values.copy()

    def soft_rows(self, kind: int) -> FloatArray:
        """See `QuadraticProgram`."""
        self._write_rows(kind)
        return self._rows.copy()

    def relax(self) -> Relaxed | SolverStatus:
        """See `QuadraticProgram`."""
        if self._status:
            return _FAULTS[self._status]
        missed = from_bits(self._bits.value)
        return Relaxed(self._minimiser.copy(), self._factor, float(self._relaxed[self._minimiser.size]), missed)

    def broken(self, plan: FloatArray, slack: float) -> Kinds:
        """See `QuadraticProgram`."""
        self._plan[:] = plan
        return from_bits(self._broken(slack))

    def least_distance(self, relaxed: Relaxed, kinds: Kinds) -> CompiledLeastDistance:  # noqa: ARG002 - it is in C
        """See `QuadraticProgram`; `relaxed` is the one of this program, which C has kept."""
        return self._least_distance.load(kinds)
