"""Sent commands, including commands that the dead time still delays."""

from __future__ import annotations

from collections import deque

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray


class PastCommands:
    """Past commands, newest last, for a history of `oldest` ticks and the dead time."""

    def __init__(self, model: DiscreteModel, oldest: int, spare: int) -> None:
        self.model, self.oldest, self.spare = model, oldest, spare
        self.clear()

    def clear(self) -> None:
        """Reset to the commands of a long rest."""
        length = self.memory + self.oldest + 2
        self._sent = deque([np.zeros(2)] * length, maxlen=length)

    def append(self, command: FloatArray) -> None:
        """Append the command (2,) sent at this tick."""
        self._sent.append(np.array(command, dtype=float))

    def correct_last(self, received: FloatArray) -> None:
        """Replace the newest command by the received command (2,)."""
        self._sent[-1] = np.array(received, dtype=float)

    def overrule(self, commands: FloatArray) -> None:
        """Replace the newest commands by commands (K, 2) of another sender, oldest first."""
        self._sent.extend([*list(self._sent)[: -len(commands)], *np.array(commands, dtype=float)])

    @property
    def memory(self) -> int:
        """Number of commands that can act in the future, including `spare` samples of unknown delay."""
        return self.model.memory + self.spare + 1

    @property
    def last(self) -> FloatArray:
        """Newest command (2,)."""
        return self._sent[-1].copy()

    @property
    def everything(self) -> FloatArray:
        """All stored commands (n, 2), oldest first."""
        return np.array(self._sent)

    @property
    def recent(self) -> FloatArray:
        """Commands (memory, 2) that can act in the future, oldest first."""
        return np.array(self._sent)[-self.memory :]

    def acting(self, ticks_ago: int) -> FloatArray:
        """Return u[k - delay - i] (i, 2), i from 0 to spare + 2, for the interval of the command sent `ticks_ago`."""
        newest = len(self._sent) - 1 - ticks_ago - self.model.delay
        indices = np.maximum(newest - np.arange(self.spare + 3)[:, None], 0)
        return self.everything[indices, [0, 1]]
