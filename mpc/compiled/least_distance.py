"""The condensed problem as a least-distance problem, in C: the numbers of `mpc.qp.least_distance`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.compiled.library import callable_in, checked_size, pointer
from diffdrive_mpc.mpc.quadratic_program import Found, Kinds

_KINDS = 9


class CompiledLeastDistance:
    """Implements `mpc.quadratic_program.LeastDistance` on the memory of C; valid until the next `load`."""

    def __init__(self, library: ctypes.CDLL, n: int, *problem: ctypes.c_void_p) -> None:
        self._steps, most = n // 2, _KINDS * n // 2
        self._memory = np.zeros(checked_size(library, "ddmpc_least_distance_size") // 8)
        parts = np.split(self._memory, np.cumsum([n, 2, most, most, most, most * n]))
        self._plan, self._residuals, self._multipliers, self._upper, self._lower, rows = parts[:6]
        self._all_rows = rows.reshape(most, n)
        self._z, self._pressing, self._flags = np.zeros(n), np.zeros(most), np.zeros(most, dtype=np.intc)
        self._near, self._kinds = np.zeros((_KINDS, n // 2)), 0
        address = ctypes.c_void_p
        *_, relaxed = problem
        own, z, pressing = pointer(self._memory), pointer(self._z), pointer(self._pressing)
        near, marks = pointer(self._near), pointer(self._flags)
        to = callable_in(library, "ddmpc_to_least_distance", None, *(address,) * 5, ctypes.c_int, address)
        self._to: Callable[[int], None] = lambda kinds: to(*problem, kinds, own)
        mark = callable_in(library, "ddmpc_row_flags", None, ctypes.c_int, address, ctypes.c_double, address)
        self._mark: Callable[[float], None] = lambda price: mark(self._kinds, near, price, marks)
        back = callable_in(
            library, "ddmpc_from_least_distance", ctypes.c_int, address, ctypes.c_int, address, address, address
        )
        self._back: Callable[[], int] = lambda: back(relaxed, self._kinds, z, pressing, own)

    def load(self, kinds: Kinds) -> CompiledLeastDistance:
        """Write rows and bounds of these kinds of limit."""
        self._kinds = sum(1 << kind for kind in kinds)
        self._to(self._kinds)
        count = self._count = self._steps * len(kinds)
        self.upper, self.lower, self.rows = self._upper[:count], self._lower[:count], self._all_rows[:count]
        return self

    def flags(self, multipliers: FloatArray, price: float) -> NDArray[np.intc]:
        """See `mpc.quadratic_program.LeastDistance`."""
        self._near[:] = multipliers
        self._mark(price)
        return self._flags[: self._count]

    def found(self, z: FloatArray, pressing: FloatArray) -> Found:
        """See `mpc.quadratic_program.LeastDistance`."""
        self._z[:] = z
        self._pressing[: len(pressing)] = pressing
        kinds = from_bits(self._back())
        excess, residual = self._residuals.tolist()
        return Found(self._plan.copy(), excess, residual, self._multipliers.reshape(_KINDS, -1).copy(), kinds)


def from_bits(bits: int) -> Kinds:
    """The kinds of limit whose bits are set."""
    return tuple(kind for kind in range(bits.bit_length()) if bits >> kind & 1) if bits else ()
