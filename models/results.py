"""What all results have in common: their arrays cannot be written to, and they print as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class ReadOnlyArrays:
    """Base of a frozen dataclass, without slots, whose arrays are views that refuse to be written to.

    The caller's own arrays are not changed. A result that was pickled is read-only again where it is unpickled.
    """

    def __post_init__(self) -> None:
        """Put views in place of the arrays."""
        self.__setstate__(vars(self).copy())

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take in the fields."""
        for name, value in state.items():
            vars(self)[name] = _locked(value) if isinstance(value, np.ndarray) else value


def text_table(rows: Sequence[Sequence[str]], title: str = "", note: str = "") -> str:
    """Cells as aligned lines: the first row has the headings, the first column names, the others numbers.

    Parameters
    ----------
    rows
        As many cells in each.
    title, note
        Lines above and below.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([cells[0].ljust(widths[0]), *map(str.rjust, cells[1:], widths[1:])]).rstrip() for cells in rows]
    return "\n".join([*([title] if title else []), *lines, *([note] if note else [])])


def _locked(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    view = array.view()
    view.setflags(write=False)
    return view
