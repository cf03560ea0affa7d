"""A row of numbers that grows while a long log is read, with hardly more memory than it takes in the end."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)
_ROOM = 8
"""Room for the eighth part more is made at a time, so that copying stays rare."""


class Growing(Generic[_Scalar]):
    """Values of one kind, in the order in which they came.

    Parameters
    ----------
    dtype
        Kind of the values.
    zeros
        Zeros to begin with.
    width
        Values of a row; None for a row of single values.
    """

    def __init__(self, dtype: type[_Scalar], zeros: int = 0, width: int | None = None) -> None:
        self._shape: tuple[int, ...] = () if width is None else (width,)
        self._values: NDArray[_Scalar] = np.zeros((zeros, *self._shape), dtype)
        self._count = zeros

    def __len__(self) -> int:
        """Rows so far."""
        return self._count

    def extend(self, block: NDArray[_Scalar]) -> None:
        """Put a block behind the others."""
        end = self._count + len(block)
        if end > len(self._values):
            # Memory is moved by pages where it can be: no second copy beside it.
            self._values.resize((end + end // _ROOM, *self._shape), refcheck=False)
        self._values[self._count : end] = block
        self._count = end

    def array(self) -> NDArray[_Scalar]:
        """All of them, (n,) or (n, width); nothing may follow."""
        self._values.resize((self._count, *self._shape), refcheck=False)
        return self._values
