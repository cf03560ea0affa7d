"""Time replays that take turns block by block, and measure disturbed blocks again.

Slow disturbances of the machine then affect all replays equally, and caches are equally warm.
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
"""Number of ticks in a turn of one replay."""
COLD = 1
"""Number of ticks at the start of a turn that are not timed: with cold caches they take four times as long."""
STRETCH = 2e-3
"""Maximum duration of a stretch, the part of a turn that is checked for disturbances as a unit [s].

The whole turn of a slow controller would rarely be undisturbed.
"""
AGAIN = 4
"""Maximum number of additional replays after disturbed blocks."""
PATIENCE = 0.5
"""Time limit, as a multiple of the duration of the requested replays."""


class Replay(Protocol):
    """A recorded drive that can be repeated from its start any number of times."""

    @property
    def ticks(self) -> int:
        """Return the number of ticks."""
        ...

    def restart(self) -> None:
        """Restart before the first tick."""
        ...

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort] | None:
        """Run the ticks `first` to `last` - 1; return times (ticks, 2) of the whole step and of the solve [s].

        None if the replay has failed; it then takes no more turns.
        """
        ...


@dataclass(frozen=True)
class TurnTimes:
    """Times of one replay.

    Attributes
    ----------
    times
        (repetitions, ticks, 2) times of the whole step and of the solve [s]; NaN if missing, and for cold ticks.
    clean
        (repetitions, ticks) True if the stretch of the tick was undisturbed.
    """

    times: FloatArray
    clean: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Share of clean ticks over all repetitions."""
        return float(self.clean.mean())

    @property
    def only_clean(self) -> FloatArray:
        """The times with NaN for disturbed ticks."""
        return np.where(self.clean[..., None], self.times, np.nan)

    @property
    def selected(self) -> FloatArray:
        """The times with NaN for disturbed ticks; all times if no tick is clean."""
        return self.only_clean if self.clean.any() else self.times


class _Measured(NamedTuple):
    """One turn."""

    times: FloatArray
    effort: Effort


@dataclass(eq=False)
class _Track:
    """Replay, and its results so far by the first tick of the stretch."""

    replay: Replay
    repetitions: int
    blocks: dict[int, list[_Measured]] = field(default_factory=dict)
    failed: bool = False
    stretch: int = 0

    def stretches(self, first: int, last: int) -> list[tuple[int, int]]:
        """Split a turn into stretches; the first turn is one stretch."""
        size = self.stretch if first and self.stretch else last - first
        return [(start, min(start + size, last)) for start in range(first, last, size)]

    def take(self, first: int, last: int) -> None:
        """Take a turn."""
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
        """Return the tick after the last turn with a stretch that lacks clean measurements; 0 if there is none."""
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
            # Disturbed measurements fill in for missing undisturbed ones, and are not marked clean.
            good = self.clean(first, best)
            bad = [turn for turn in turns if not turn.effort.undisturbed(best)]
            chosen = (good + bad)[: self.repetitions]
            for row, measured in enumerate(chosen):
                place = slice(first, first + len(measured.times))
                times[row, place], clean[row, place] = measured.times, row < len(good)
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
    """Repeat all replays until every block has its undisturbed measurements, within the limits `AGAIN` and `PATIENCE`.

    Parameters
    ----------
    groups
        Groups of replays; the replays of a group are compared with each other and take turns.
    repetitions
        Requested number of undisturbed measurements of each block.
    block
        Number of ticks in a turn.
    on_replay
        Function that is called for each replay of the first pass.

    Returns
    -------
    times
        Times of each replay of each group.
    best
        Minimum time of the yardstick [s]; see `bench.counters`.
    """
    tracks = [[_Track(replay, repetitions) for replay in group] for group in groups]
    best = np.inf
    began, deadline = perf_counter(), np.inf
    for again in range(repetitions + AGAIN):
        if again == repetitions:
            deadline = began + (1.0 + PATIENCE) * (perf_counter() - began)
        for group in tracks:
            if perf_counter() > deadline:
                break
            _run_pass([track for track in group if track.end(best, block)], best, block)
            best = min(
                [best, *(turn.effort.pace for track in group for turns in track.blocks.values() for turn in turns)]
            )
            for _ in group if again == 0 else []:
                on_replay()
    return [[track.result(best, block) for track in group] for group in tracks], float(best)


def _run_pass(group: list[_Track], best: float, block: int) -> None:
    """Run one pass of a group: each replay runs all turns up to its last block that lacks clean measurements."""
    ends = {id(track): track.end(best, block) for track in group}
    for track in group:
        track.replay.restart()
    for turn, first in enumerate(range(0, max(ends.values(), default=0), block)):
        # The first replay of a turn alternates.
        for track in itertools.islice(itertools.cycle(group), turn % len(group), turn % len(group) + len(group)):
            last = min(first + block, ends[id(track)])
            if not track.failed and first < last:
                track.take(first, last)
