"""From records to windows of commands with the twist that follows each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import Experiment


@dataclass(frozen=True)
class Windows:
    """K windows of W commands (K, W, 2), oldest first, and the twists (K, 2) one sample after their newest command."""

    commands: FloatArray
    twists: FloatArray

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.twists)

    def part(self, first: int, stop: int) -> Windows:
        """The windows from `first` up to, and without, `stop`."""
        return Windows(self.commands[first:stop], self.twists[first:stop])


def windows_of(experiments: Sequence[Experiment], window: int) -> Windows:
    """Every window whose next sample has a reading of both outputs, in the order of time.

    Raises
    ------
    ValueError
        If no stretch is as long as a window.
    """
    commands, twists = [], []
    for experiment in experiments:
        if experiment.samples <= window:
            continue
        views = np.lib.stride_tricks.sliding_window_view(experiment.inputs, window, axis=0)[:-1].transpose(0, 2, 1)
        counts = experiment.counts[window:].all(axis=1)
        commands.append(views[counts])
        twists.append(experiment.outputs[window:][counts])
    if not commands:
        raise ValueError(f"no stretch of the log is longer than the window of {window} samples; give a longer log")
    return Windows(np.concatenate(commands), np.concatenate(twists))


def fit_percent(network: Callable[[FloatArray], FloatArray], windows: Windows) -> FloatArray:
    """(2,) FIT of v and omega over windows [%], 100 (1 - |y - yhat| / |y - mean(y)|)."""
    error = np.linalg.norm(windows.twists - network(windows.commands), axis=0)
    return np.asarray(100.0 * (1.0 - error / np.linalg.norm(windows.twists - windows.twists.mean(axis=0), axis=0)))


def rmse(network: Callable[[FloatArray], FloatArray], windows: Windows) -> FloatArray:
    """(2,) root mean square error of v [m/s] and omega [rad/s] over windows."""
    return np.asarray(np.sqrt(np.mean((windows.twists - network(windows.commands)) ** 2, axis=0)))


def divided(windows: Windows, shares: Sequence[float]) -> tuple[Windows, ...]:
    """Parts of these shares, one after the other in time: neighbouring windows share their commands."""
    cuts = [0, *np.rint(np.cumsum(shares) * len(windows)).astype(int).tolist()]
    return tuple(windows.part(first, stop) for first, stop in pairwise(cuts))
