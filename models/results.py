"""What results have in common: their arrays cannot be written to."""

from __future__ import annotations

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


def _locked(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    view = array.view()
    view.setflags(write=False)
    return view
