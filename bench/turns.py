"""Time replays that alternate block by block, and measure disturbed blocks again.

Slow disturbances of the computer then affect all replays equally, and the caches are equally warm.
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
COLD = 1
"""Number of ticks at the start of a turn that are not timed; because of cold caches they take four times as long."""
STRETCH = 2e-3
"""Maximum duration of a stretch, which is the part of a turn that is checked for disturbances as a unit [s].

A whole turn of a slow controller is rarely undisturbed.
"""
MAX_REPEATS = 4
"""Maximum number of additional replays because of disturbed blocks."""
MAX_REPEAT_SHARE = 0.5
"""Maximum duration of the additional replays, as a multiple of the duration of the requested replays."""


class Replay(Protocol):
    """Recorded run that can be repeated from its start any number of times."""

    @property
    def ticks(self) -> int:
        """Return the number of ticks."""
        ...

    def restart(self) -> None:
        """Return to the start, before the first tick."""
        ...

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort] | None:
        """Run ticks `first` to `last` - 1; return times (ticks, 2) of the steps and of their solves [s].

        Returns None if the replay has failed; it then has no further turns.
        """
        ...


@dataclass(frozen=True)
class TurnTimes:
    """Step times of a replay.

    Attributes
    ----------
    times
        (repetitions, ticks, 2) times of the step and of its solve [s]; NaN if missing and at ticks with cold caches.
    clean
        (repetitions, ticks) whether the stretch of the tick was undisturbed.
    """

    times: FloatArray
    clean: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Share of undisturbed ticks in all repetitions."""
        return float(self.clean.mean())

    @property
    def only_clean(self) -> FloatArray:
        """Times, with NaN for disturbed ticks."""
        return np.where(self.clean[..., None], self.times, np.nan)

    @property
    def selected(self) -> FloatArray:
        """Times, with NaN for disturbed ticks; if all ticks are disturbed, all times."""
        return self.only_clean if self.clean.any() else self.times


class _Measured(NamedTuple):
    """Measurement of a stretch."""

    times: FloatArray
    effort: Effort


@dataclass(eq=False)
class _Track:
    """Replay and its results so far, by first tick of the stretch."""

    replay: Replay
    repetitions: int
    blocks: dict[int, list[_Measured]] = field(default_factory=dict)
    failed: bool = False
    stretch: int = 0

    def stretches(self, first: int, last: int) -> list[tuple[int, int]]:
        """Split a turn into stretches; the first turn is a single stretch."""
        size = self.stretch if first and self.stretch else last - first
        return [(start, min(start + size, last)) for start in range(first, last, size)]

    def run_turn(self, first: int, last: int) -> None:
        """Run and measure a turn."""
        for start, end in self.stretches(first, last):
            result = self.replay.run(start, end)
            if result is None:
                self.failed = True
                break
            turn = _Measured(*result)
            self.blocks.setdefault(start, []).append(turn)
            if not self.stretch:
                self.stretch = max(1, int(STRETCH / max(turn.effort.elapsed / (end - start), 1e-9)))

    def clean(self, block: int, best: float) -> list[_Measured]:
        """Return the undisturbed measurements of the stretch that starts at tick `block`."""
        return [turn for turn in self.blocks.get(block, []) if turn.effort.undisturbed(best)]

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
        for first, turns in self.blocks.items():
            # Disturbed measurements take the place of missing undisturbed ones, but are not marked as clean.
            undisturbed = self.clean(first, best)
            disturbed = [turn for turn in turns if not turn.effort.undisturbed(best)]
            used = (undisturbed + disturbed)[: self.repetitions]
            for row, measured in enumerate(used):
                stretch = slice(first, first + len(measured.times))
                times[row, stretch], clean[row, stretch] = measured.times, row < len(undisturbed)
                if first % block == 0:
                    times[row, first : first + COLD] = np.nan
        return TurnTimes(times, clean)


def take_turns(
    groups: Sequence[Sequence[Replay]],
    *,
    repetitions: int = 1,
    block: int = BLOCK,
    on_replay: Callable[[], None] = lambda: None,
) -> tuple[list[list[TurnTimes]], float]:
    """Repeat all replays until every block has enough undisturbed measurements.

    `MAX_REPEATS` and `MAX_REPEAT_SHARE` limit the repetitions.

    Parameters
    ----------
    groups
        Groups of replays; the replays of a group are compared with each other and alternate.
    repetitions
        Requested number of undisturbed measurements of each block.
    block
        Number of ticks in a turn.
    on_replay
        Function that is called after each replay of the first pass.

    Returns
    -------
    times
        Times of each replay of each group.
    best
        Minimum time of the yardstick [s]; see `bench.counters`.
    """
    tracks = [[_Track(replay, repetitions) for replay in group] for group in groups]
    best = np.inf
    start, deadline = perf_counter(), np.inf
    for pass_number in range(repetitions + MAX_REPEATS):
        if pass_number == repetitions:
            deadline = start + (1.0 + MAX_REPEAT_SHARE) * (perf_counter() - start)
        for group in tracks:
            if perf_counter() > deadline:
                break
            _run_pass([track for track in group if track.end(best, block)], best, block)
            best = min(
                [best, *(turn.effort.pace for track in group for turns in track.blocks.values() for turn in turns)]
            )
            for _ in group if pass_number == 0 else []:
                on_replay()
    return [[track.result(best, block) for track in group] for group in tracks], float(best)


def _run_pass(group: list[_Track], best: float, block: int) -> None:
    """Run one pass of a group: each replay runs all turns up to its last block that lacks undisturbed measurements."""
    ends = {id(track): track.end(best, block) for track in group}
    for track in group:
        track.replay.restart()
    for turn, first in enumerate(range(0, max(ends.values(), default=0), block)):
        # Each turn starts with another replay.
        for track in itertools.islice(itertools.cycle(group), turn % len(group), turn % len(group) + len(group)):
            last = min(first + block, ends[id(track)])
            if not track.failed and first < last:
                track.run_turn(first, last)
