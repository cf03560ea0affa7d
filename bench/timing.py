"""Times of steps: recorded measurements replayed through fresh controllers that take turns on one core.

Runs are recorded in parallel, where neighbours disturb the clock. The replay also proves determinism: it must give the
same commands bit for bit.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller
from diffdrive_mpc.bench.counters import Effort, busy_time, watched
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.runner import NotReproducibleError, OnDone
from diffdrive_mpc.bench.turns import take_turns
from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.sim import Run

K = TypeVar("K")
_WARM_UP_TICKS = 25


@contextmanager
def quiet_core() -> Iterator[int | None]:
    """Reserve one core if the system permits, with one BLAS thread and no garbage collection; undo it at the end.

    Gives the number of the core.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    collecting = gc.isenabled()
    core = max(cores) if cores else None
    with threadpool_limits(limits=1):
        if core is not None:
            os.sched_setaffinity(0, {core})
        gc.collect()
        gc.freeze()  # existing objects need not be searched again between runs
        gc.disable()
        try:
            yield core
        finally:
            gc.unfreeze()
            if collecting:
                gc.enable()
            if cores:
                os.sched_setaffinity(0, cores)


@dataclass(frozen=True)
class TimingPass:
    """State of the machine during the timing.

    Attributes
    ----------
    clean_share
        Share of the ticks with an undisturbed measurement [-].
    others_share
        Share of the time for which other programs had the core [-], as far as the system reports it.
    yardstick
        Minimum time of the yardstick of `bench.counters` [s]: times of two reports compare as far as these agree.
    """

    clean_share: float = 1.0
    others_share: float = 0.0
    yardstick: float = float("nan")


UNDISTURBED = TimingPass()
"""Timing pass without timed runs."""


def time_outcomes(outcomes: Sequence[RunOutcome], on_done: OnDone) -> tuple[list[RunOutcome], TimingPass]:
    """Replace the times by those of replays on one quiet core; those of the same place take turns.

    Returns
    -------
    outcomes
        With the new times; NaN for ticks that were disturbed whenever they were measured, unless a controller has no
        others: then those of all controllers are kept.
    timing
        State of the machine during the timed runs.

    Raises NotReproducibleError if a replay commanded something else than the run.
    """
    groups = list(_grouped(outcomes, lambda outcome: _place(outcome.case)).values())
    with quiet_core() as core:
        began, processor, counted = time.perf_counter(), time.process_time(), busy_time(core)
        replays = [[CaseReplay(outcome.case, outcome.run) for outcome in place] for place in groups]
        durations, best = take_turns(replays, on_replay=on_done)
        busy = busy_time(core) - counted - (time.process_time() - processor)
        others = max(0.0, busy) / (time.perf_counter() - began)
    times = {
        outcome.case: replayed
        for place, several in zip(groups, durations, strict=True)
        for outcome, replayed in zip(place, several, strict=True)
    }
    # Ticks left out of one controller's times are left out of all.
    drivers = _grouped(outcomes, lambda outcome: _driver(outcome.case)).values()
    alike = all(any(times[outcome.case].clean.any() for outcome in runs) for runs in drivers)
    timed = {}
    for outcome in outcomes:
        measured = times[outcome.case]
        selected = measured.only_clean if alike else measured.times
        timed[outcome.case] = replace(
            outcome, run=outcome.run.with_step_time(*selected[0].T), clean_share=measured.share
        )
    ticks = [len(outcome.run.time) for outcome in outcomes]
    clean = float(np.average([timed[outcome.case].clean_share for outcome in outcomes], weights=ticks))
    return [timed[outcome.case] for outcome in outcomes], TimingPass(clean, others, best)


def _grouped(outcomes: Sequence[RunOutcome], key: Callable[[RunOutcome], K]) -> dict[K, list[RunOutcome]]:
    """Group outcomes by a key, in the order of first appearance."""
    groups: dict[K, list[RunOutcome]] = {}
    for outcome in outcomes:
        groups.setdefault(key(outcome), []).append(outcome)
    return groups


def _place(case: Case) -> Case:
    """Return the case without the fields in which compared cases differ."""
    return replace(case, controller="", model="", config=None, overrides=())


def _driver(case: Case) -> tuple[object, ...]:
    """Return the fields that distinguish controllers."""
    return case.controller, case.model, case.config, case.overrides


class CaseReplay:
    """A fresh controller for `case` that gets the measurements of `run`; satisfies `bench.turns.Replay`.

    Another instance takes a few steps first, so that imports and one-time costs do not count.
    """

    def __init__(self, case: Case, run: Run) -> None:
        self._case, self._run = case, run
        self._controller: TrackingController | None = None

    @property
    def ticks(self) -> int:
        """Number of ticks of the run."""
        return len(self._run.time)

    def restart(self) -> None:
        """Make the controller."""
        warm = make_controller(self._case)
        warm.start(self._run.reference, float(self._run.time[0]))
        replay(warm, self._run, 0, min(_WARM_UP_TICKS, self.ticks))
        self._controller = make_controller(self._case)
        self._controller.start(self._run.reference, float(self._run.time[0]))
        gc.collect()

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort]:
        """Replay ticks; return times (ticks, 2) of whole steps and solves [s]; raise as `replay`."""
        controller = self._controller
        assert controller is not None
        times, effort = watched(lambda: replay(controller, self._run, first, last))
        if last == self.ticks:
            self._controller = None  # its memory is not needed any more
        return times, effort


def replay(controller: TrackingController, run: Run, first: int, last: int) -> FloatArray:
    """Replay the measurements of the ticks `first` to `last` - 1 of `run` with `controller`, and time them.

    Returns
    -------
    FloatArray
        (ticks, 2) of the whole step, and of the solve by the controller's own clock, NaN where there was none [s].

    Raises NotReproducibleError if a command differs from the recorded one in any bit.
    """
    took, commands = np.empty((last - first, 2)), np.empty((last - first, 2))
    for k in range(first, last):
        t, measurement = float(run.time[k]), run.measurements[k]
        began = time.perf_counter()
        step = controller.step(t, measurement)
        took[k - first, 0] = time.perf_counter() - began
        took[k - first, 1] = step.solve_time
        commands[k - first] = step.command
    differs = np.flatnonzero((commands != run.command[first:last]).any(axis=1))
    if differs.size:
        k = first + differs[0]
        raise NotReproducibleError(
            f"{run.reference.name}, t = {run.time[k]:.3f} s: the replay commanded {commands[k - first].tolist()}, the "
            f"run {run.command[k].tolist()}: the controller is not deterministic"
        )
    return took
