"""A sparse matrix of fixed pattern, put together from its entries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from diffdrive_mpc.models.interface import FloatArray

Indices = NDArray[np.intp]


class Pattern:
    """Entries (row, column, value), each place at most once; a place may hold zero for now."""

    def __init__(self) -> None:
        self._rows: list[Indices] = []
        self._columns: list[Indices] = []
        self._values: list[FloatArray] = []

    def add(self, rows: ArrayLike, columns: ArrayLike, values: ArrayLike = 0.0) -> slice:
        """Add entries, broadcast against each other; returns which of all entries they are, flattened."""
        row, column, value = np.broadcast_arrays(
            np.asarray(rows, dtype=np.intp), np.asarray(columns, dtype=np.intp), np.asarray(values, dtype=float)
        )
        first = sum(len(part) for part in self._rows)
        for parts, part in ((self._rows, row), (self._columns, column), (self._values, value)):
            parts.append(part.reshape(-1).copy())
        return slice(first, first + row.size)

    def build(self, rows: int, columns: int) -> tuple[sparse.csc_matrix, Indices]:
        """The (rows, columns) matrix by columns, and where in its data each entry lies."""
        row, column, value = (np.concatenate(parts) for parts in (self._rows, self._columns, self._values))
        order = np.lexsort((row, column))
        place = np.empty(len(order), dtype=np.intp)
        place[order] = np.arange(len(order))
        starts = np.searchsorted(column[order], np.arange(columns + 1))
        return sparse.csc_matrix((value[order], row[order], starts), shape=(rows, columns)), place
