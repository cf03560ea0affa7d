"""The commands already sent: what still travels through the dead time."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray


class CommandLine:
    """A buffer of past commands, newest last, long enough for the dead time and for the estimator's history.

    Parameters
    ----------
    model
        The sampled model: its delays say which past command acts when.
    history
        Ticks by which an interval may lie in the past and still be recomputed.
    line
        (memory + history + 2, 2) memory to use.
    """

    def __init__(self, model: DiscreteModel, history: int, line: FloatArray | None = None) -> None:
        self._delay = model.delay
        self._memory = model.memory
        self._line = np.zeros((model.memory + history + 2, 2)) if line is None else line
        self.oldest = history
        """Ticks ago of the oldest interval that `acting` reaches."""

    def clear(self) -> None:
        """As after a long rest."""
        self._line[:] = 0.0

    def append(self, command: FloatArray) -> None:
        """Enter the command (2,) sent at this tick."""
        self._line[:-1] = self._line[1:]
        self._line[-1] = command

    def correct_last(self, sent: FloatArray) -> None:
        """Replace the newest entry by what the robot really got (2,)."""
        self._line[-1] = sent

    @property
    def last(self) -> FloatArray:
        """(2,) the newest command."""
        return np.array(self._line[-1])

    @property
    def recent(self) -> FloatArray:
        """(memory, 2) the commands that still act on the future, oldest first."""
        return self._line[-self._memory :].copy()

    def acting(self, ticks_ago: int) -> tuple[FloatArray, FloatArray]:
        """u[k - delay] and u[k - delay - 1] (2,) for the interval that the command sent `ticks_ago` began."""
        rows = len(self._line) - 1 - ticks_ago - self._delay
        return self._line[rows, (0, 1)], self._line[rows - 1, (0, 1)]
