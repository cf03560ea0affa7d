"""Step times of replays that alternate block by block; disturbed blocks are measured again.

Because the replays alternate, slow changes of the computer's speed affect all replays equally.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.models.interface import FloatArray

BLOCK = 25
"""Number of ticks that a replay runs in one turn."""
COLD_TICKS = 1
"""Number of ticks at the start of a turn whose times are omitted; with cold caches, steps take four times as long."""
MAX_STRETCH_TIME = 2e-3
"""Maximum duration of a stretch, the part of a turn that is checked for disturbances as a unit [s].

A whole turn of a slow controller would rarely be undisturbed.
"""
MAX_REPEATS = 4
"""Maximum number of additional replays because of disturbed blocks."""
MAX_REPEAT_SHARE = 0.5
"""Maximum duration of the additional replays, as a multiple of the duration of the requested replays."""


class Replay(Protocol):
    """Recorded run that can be replayed any number of times."""

    @property
    def ticks(self) -> int:
        """Return the number of ticks."""
        ...

    def restart(self) -> None:
        """Return to the time before the first tick."""
        ...

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort] | None:
        """Run ticks `first` to `last` - 1; return times (ticks, 2) of the steps and of their solves [s].

        Return None if the replay has failed; it then has no further turns.
        """
        ...


@dataclass(frozen=True)
class TurnTimes:
    """Step times of a replay.

    Attributes
    ----------
    times
        (repetitions, ticks, 2) times of the step and of its solve [s]; NaN if missing, and at ticks with cold caches.
    clean
        (repetitions, ticks) mask, True if the stretch of the tick was undisturbed.
    """

    times: FloatArray
    clean: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Share of undisturbed ticks in all repetitions."""
        return float(self.clean.mean())

    @property
    def undisturbed_times(self) -> FloatArray:
        """Times, with NaN for disturbed ticks."""
        return np.where(self.clean[..., None], self.times, np.nan)

    @property
    def selected(self) -> FloatArray:
        """Times, with NaN for disturbed ticks; if all ticks are disturbed, all times."""
        return self.undisturbed_times if self.clean.any() else self.times


class _Measurement(NamedTuple):
    """Measurement of a stretch."""

    times: FloatArray
    effort: Effort


@dataclass(eq=False)
class _ReplayResults:
    """Replay and its measurements so far, by first tick of the stretch."""

    replay: Replay
    repetitions: int
    measurements: dict[int, list[_Measurement]] = field(default_factory=dict)
    failed: bool = False
    stretch_ticks: int = 0

    def stretches(self, first: int, last: int) -> list[tuple[int, int]]:
        """Split a turn into stretches; the first turn is a single stretch, from which the step time is estimated."""
        size = self.stretch_ticks if first and self.stretch_ticks else last - first
        return [(start, min(start + size, last)) for start in range(first, last, size)]

    def run_turn(self, first: int, last: int) -> None:
        """Measure all stretches of a turn."""
        for start, end in self.stretches(first, last):
            result = self.replay.run(start, end)
            if result is None:
                self.failed = True
                break
            measurement = _Measurement(*result)
            self.measurements.setdefault(start, []).append(measurement)
            if not self.stretch_ticks:
                self.stretch_ticks = max(
                    1, int(MAX_STRETCH_TIME / max(measurement.effort.elapsed / (end - start), 1e-9))
                )

    def clean(self, first: int, best: float) -> list[_Measurement]:
        """Return the undisturbed measurements of the stretch that starts at tick `first`."""
        return [entry for entry in self.measurements.get(first, []) if entry.effort.is_undisturbed(best)]

    def end(self, best: float, block: int) -> int:
        """Return the end of the last turn that lacks undisturbed measurements; 0 if there is no such turn."""
        if self.failed:
            return 0
        ticks = self.replay.ticks
        for first in reversed(range(0, ticks, block)):
            last = min(first + block, ticks)
            if any(len(self.clean(start, best)) < self.repetitions for start, _ in self.stretches(first, last)):
                return last
        return 0

    def result(self, best: float, block: int) -> TurnTimes:
        times = np.full((self.repetitions, self.replay.ticks, 2), np.nan)
        clean = np.zeros(times.shape[:2], dtype=bool)
        for first, measurements in self.measurements.items():
            # If undisturbed measurements are missing, disturbed ones are used, but not marked as clean.
            undisturbed = self.clean(first, best)
            disturbed = [entry for entry in measurements if not entry.effort.is_undisturbed(best)]
            selected = (undisturbed + disturbed)[: self.repetitions]
            for row, measurement in enumerate(selected):
                stretch = slice(first, first + len(measurement.times))
                times[row, stretch], clean[row, stretch] = measurement.times, row < len(undisturbed)
                if first % block == 0:
                    times[row, first : first + COLD_TICKS] = np.nan
        return TurnTimes(times, clean)


def take_turns(
    groups: Sequence[Sequence[Replay]],
    *,
    repetitions: int = 1,
    block: int = BLOCK,
    on_replay: Callable[[], None] = lambda: None,
) -> tuple[list[list[TurnTimes]], float]:
    """Run all replays, and repeat them until every block has `repetitions` undisturbed measurements.

    `MAX_REPEATS` and `MAX_REPEAT_SHARE` limit the number and the duration of the repetitions.

    Parameters
    ----------
    groups
        Groups of replays; the replays of a group alternate, because their times are compared.
    repetitions
        Requested number of undisturbed measurements of each block.
    block
        Number of ticks in a turn.
    on_replay
        Function that is called for each replay after the first pass of its group.

    Returns
    -------
    times
        Times of each replay of each group.
    best
        Minimum time of the yardstick [s]; see `bench.counters`.
    """
    all_results = [[_ReplayResults(replay, repetitions) for replay in group] for group in groups]
    best = np.inf
    start, deadline = perf_counter(), np.inf
    for pass_number in range(repetitions + MAX_REPEATS):
        if pass_number == repetitions:
            deadline = start + (1.0 + MAX_REPEAT_SHARE) * (perf_counter() - start)
        for group in all_results:
            if perf_counter() > deadline:
                break
            _run_pass([results for results in group if results.end(best, block)], best, block)
            best = min(
                [
                    best,
                    *(
                        turn.effort.pace
                        for results in group
                        for turns in results.measurements.values()
                        for turn in turns
                    ),
                ]
            )
            for _ in group if pass_number == 0 else []:
                on_replay()
    return [[results.result(best, block) for results in group] for group in all_results], float(best)


def _run_pass(group: list[_ReplayResults], best: float, block: int) -> None:
    """Run one pass of a group: each replay runs all turns up to its last block that lacks undisturbed measurements."""
    ends = {id(results): results.end(best, block) for results in group}
    for results in group:
        results.replay.restart()
    for turn, first in enumerate(range(0, max(ends.values(), default=0), block)):
        # Each turn starts with another replay.
        for results in itertools.islice(itertools.cycle(group), turn % len(group), turn % len(group) + len(group)):
            last = min(first + block, ends[id(results)])
            if not results.failed and first < last:
                results.run_turn(first, last)
