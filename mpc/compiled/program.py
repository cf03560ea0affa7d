"""The condensed quadratic program on the memory of C."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping

import numpy as np

from models.interface import FloatArray
from mpc.compiled.least_distance import CompiledLeastDistance
from mpc.compiled.library import bound_function, callable_in, checked_size, pointer
from mpc.quadratic_program import Kinds, Relaxed
from mpc.solver_report import SolverStatus

# By the values of ddmpc_relax_status.
_FAULTS = {1: SolverStatus.NOT_FINITE, 2: SolverStatus.NOT_CONVEX}


class CompiledProgram:
    """Implements `mpc.quadratic_program.QuadraticProgram` on the memory of C; rows are written where asked for.

    Parameters
    ----------
    library
        The compiled sources.
    data, slew, last_command
        The fields of ddmpc_qp, and what the program has beside them.
    constants, tick, work, qp
        Addresses of the C structs.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        data: Mapping[str, FloatArray],
        slew: FloatArray,
        last_command: FloatArray,
        constants: ctypes.c_void_p,
        tick: ctypes.c_void_p,
        work: ctypes.c_void_p,
        qp: ctypes.c_void_p,
    ) -> None:
        self.H, self.g, self.box = data["H"], data["g"], data["box"]
        self.soft_lower, self.soft_upper = data["soft_lower"], data["soft_upper"]
        self.slew, self.last_command = slew, last_command
        n, (kinds, steps) = len(self.g), self.soft_lower.shape
        self._plan, self._values, self._rows = np.zeros(n), np.zeros((kinds, steps)), np.zeros((steps, n))
        plan, values, rows = pointer(self._plan), pointer(self._values), pointer(self._rows)
        self._write_values = bound_function(library, "ddmpc_soft_values", constants, tick, work, plan, values)
        address = ctypes.c_void_p
        write = callable_in(library, "ddmpc_soft_rows", None, address, address, address, ctypes.c_int, address)
        self._write_rows: Callable[[int], None] = lambda kind: write(constants, tick, work, kind, rows)
        self._relaxed = np.zeros(checked_size(library, "ddmpc_relaxed_size") // 8)
        self._factor = self._relaxed[n + 1 : n + 1 + n * n].reshape(n, n).T
        factorise = callable_in(library, "ddmpc_relax", ctypes.c_int, address, address, address)
        relaxed = pointer(self._relaxed)
        self._relax: Callable[[], int] = lambda: factorise(tick, qp, relaxed)
        self._least_distance = CompiledLeastDistance(library, n, constants, tick, work, qp, relaxed)
        check = callable_in(library, "ddmpc_broken", ctypes.c_int, *(address,) * 5, ctypes.c_double)
        self._broken: Callable[[float], int] = lambda slack: check(constants, tick, work, qp, plan, slack)

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
        status = self._relax()
        if status:
            return _FAULTS[status]
        n = len(self.g)
        return Relaxed(self._relaxed[:n].copy(), self._factor, float(self._relaxed[n]))

    def broken(self, plan: FloatArray, slack: float) -> Kinds:
        """See `QuadraticProgram`."""
        self._plan[:] = plan
        bits = self._broken(slack)
        return tuple(kind for kind in range(bits.bit_length()) if bits >> kind & 1)

    def least_distance(self, relaxed: Relaxed, kinds: Kinds) -> CompiledLeastDistance:  # noqa: ARG002 - it is in C
        """See `QuadraticProgram`; `relaxed` is the one of this program, which C has kept."""
        return self._least_distance.load(kinds)
