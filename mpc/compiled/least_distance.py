"""The condensed problem as a least-distance problem, in C: the numbers of `mpc.qp.least_distance`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np

from models.interface import FloatArray
from mpc.compiled.library import callable_in, checked_size, pointer
from mpc.quadratic_program import Kinds

_KINDS = 9


class CompiledLeastDistance:
    """Implements `mpc.quadratic_program.LeastDistance` on the memory of C; valid until the next `load`."""

    def __init__(self, library: ctypes.CDLL, n: int, *problem: ctypes.c_void_p) -> None:
        self._n, self._steps, most = n, n // 2, _KINDS * n // 2
        self._memory = np.zeros(checked_size(library, "ddmpc_least_distance_size") // 8)
        self._bounds = n + 2
        self._all_rows = self._memory[n + 2 + 2 * most :][: most * n].reshape(most, n)
        self._z, self._pressing, self._kinds = np.zeros(n), np.zeros(most), 0
        address = ctypes.c_void_p
        *_, relaxed = problem
        own, z, pressing = pointer(self._memory), pointer(self._z), pointer(self._pressing)
        to = callable_in(library, "ddmpc_to_least_distance", None, *(address,) * 5, ctypes.c_int, address)
        self._to: Callable[[int], None] = lambda kinds: to(*problem, kinds, own)
        back = callable_in(library, "ddmpc_from_least_distance", None, address, ctypes.c_int, address, address, address)
        self._back: Callable[[int], None] = lambda kinds: back(relaxed, kinds, z, pressing, own)

    def load(self, kinds: Kinds) -> CompiledLeastDistance:
        """Write rows and bounds of these kinds of limit."""
        self._kinds = sum(1 << kind for kind in kinds)
        self._to(self._kinds)
        first, count, most = self._bounds, self._steps * len(kinds), _KINDS * self._steps
        self.upper = self._memory[first : first + count]
        self.lower = self._memory[first + most : first + most + count]
        self.rows = self._all_rows[:count]
        return self

    def solution(self, z: FloatArray, pressing: FloatArray) -> tuple[FloatArray, float, float]:
        """See `mpc.quadratic_program.LeastDistance`."""
        self._z[:] = z
        self._pressing[: len(pressing)] = pressing
        self._back(self._kinds)
        n = self._n
        return self._memory[:n].copy(), float(self._memory[n]), float(self._memory[n + 1])
