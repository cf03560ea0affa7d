"""Measurement of step times: recorded measurements are replayed through new controllers, which alternate on one core.

The runs themselves are recorded in parallel, which disturbs time measurements. The replay also checks determinism: its
commands must be bitwise equal to the recorded commands.
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
from diffdrive_mpc.bench.counters import Effort, busy_time, measure_effort
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.runner import NotReproducibleError, OnDone
from diffdrive_mpc.bench.turns import take_turns
from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.sim import Run

K = TypeVar("K")
_WARM_UP_TICKS = 25


@contextmanager
def quiet_core() -> Iterator[int | None]:
    """Restrict this process to one core and one BLAS thread, without garbage collection, within the context.

    Yield the number of the core, or None if the operating system does not support this restriction.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    is_collection_enabled = gc.isenabled()
    core = max(cores) if cores else None
    with threadpool_limits(limits=1):
        if core is not None:
            os.sched_setaffinity(0, {core})
        gc.collect()
        gc.freeze()  # explicit collections between replays ignore existing objects and are fast
        gc.disable()
        try:
            yield core
        finally:
            gc.unfreeze()
            if is_collection_enabled:
                gc.enable()
            if cores:
                os.sched_setaffinity(0, cores)


@dataclass(frozen=True)
class TimingPass:
    """State of the computer during the timing.

    Attributes
    ----------
    clean_share
        Share of the ticks with an undisturbed measurement [-].
    others_share
        Share of the time in which other programs used the core [-]; 0 if the operating system does not report it.
    yardstick
        Minimum time of the yardstick of `bench.counters` [s]; reports with the same time are comparable.
    """

    clean_share: float = 1.0
    others_share: float = 0.0
    yardstick: float = float("nan")


UNDISTURBED = TimingPass()
"""State if no runs are timed."""


def time_outcomes(outcomes: Sequence[RunOutcome], on_done: OnDone) -> tuple[list[RunOutcome], TimingPass]:
    """Measure the step times of runs by replays on one quiet core; controllers on the same plant and path alternate.

    Returns
    -------
    outcomes
        Outcomes with the measured times. Times of ticks that were disturbed in every measurement are NaN; but if all
        ticks of a controller were disturbed, the results contain the disturbed times of all controllers.
    timing
        State of the computer during the replays.

    Raise NotReproducibleError if the commands of a replay differ from those of the run.
    """
    groups = list(_group_by(outcomes, lambda outcome: _without_controller(outcome.case)).values())
    with quiet_core() as core:
        start, processor, busy_before = time.perf_counter(), time.process_time(), busy_time(core)
        replays = [[CaseReplay(outcome.case, outcome.run) for outcome in group] for group in groups]
        durations, best = take_turns(replays, on_replay=on_done)
        busy = busy_time(core) - busy_before - (time.process_time() - processor)
        foreign_share = max(0.0, busy) / (time.perf_counter() - start)
    times = {
        outcome.case: tick_times
        for group, replayed_group in zip(groups, durations, strict=True)
        for outcome, tick_times in zip(group, replayed_group, strict=True)
    }
    # The controllers are compared with each other, so disturbed ticks are omitted for all controllers or for none.
    controller_groups = _group_by(outcomes, lambda outcome: _driver(outcome.case)).values()
    all_have_clean = all(any(times[outcome.case].clean.any() for outcome in runs) for runs in controller_groups)
    timed = {}
    for outcome in outcomes:
        replayed_times = times[outcome.case]
        selected = replayed_times.undisturbed_times if all_have_clean else replayed_times.times
        timed[outcome.case] = replace(
            outcome, run=outcome.run.with_step_time(*selected[0].T), clean_share=replayed_times.share
        )
    ticks = [len(outcome.run.time) for outcome in outcomes]
    clean = float(np.average([timed[outcome.case].clean_share for outcome in outcomes], weights=ticks))
    return [timed[outcome.case] for outcome in outcomes], TimingPass(clean, foreign_share, best)


def _group_by(outcomes: Sequence[RunOutcome], key: Callable[[RunOutcome], K]) -> dict[K, list[RunOutcome]]:
    """Group outcomes by a key in the order of first appearance."""
    groups: dict[K, list[RunOutcome]] = {}
    for outcome in outcomes:
        groups.setdefault(key(outcome), []).append(outcome)
    return groups


def _without_controller(case: Case) -> Case:
    """Return the case without the fields that describe its controller."""
    return replace(case, controller="", model="", config=None, overrides=())


def _driver(case: Case) -> tuple[object, ...]:
    """Return the fields of the case that describe its controller."""
    return case.controller, case.model, case.config, case.overrides


class CaseReplay:
    """Replay of the measurements of `run` with a new controller for `case`; satisfies `bench.turns.Replay`.

    Before the replay, another instance runs a few steps, so that the times do not include imports and other costs of
    the first steps.
    """

    def __init__(self, case: Case, run: Run) -> None:
        self._case, self._run = case, run
        self._controller: TrackingController | None = None

    @property
    def ticks(self) -> int:
        """Number of ticks of the run."""
        return len(self._run.time)

    def restart(self) -> None:
        """Create and start a new controller."""
        warm_up = make_controller(self._case)
        warm_up.start(self._run.reference, float(self._run.time[0]))
        replay(warm_up, self._run, 0, min(_WARM_UP_TICKS, self.ticks))
        self._controller = make_controller(self._case)
        self._controller.start(self._run.reference, float(self._run.time[0]))
        gc.collect()

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort]:
        """Replay ticks; return times (ticks, 2) of the steps and of their solves [s]; raise the errors of `replay`."""
        controller = self._controller
        assert controller is not None
        times, effort = measure_effort(lambda: replay(controller, self._run, first, last))
        if last == self.ticks:
            self._controller = None  # release the memory
        return times, effort


def replay(controller: TrackingController, run: Run, first: int, last: int) -> FloatArray:
    """Replay the measurements of ticks `first` to `last` - 1 of `run` with `controller`, and time its steps.

    Returns
    -------
    FloatArray
        (ticks, 2) times of the step, and of its solve as reported by the controller; NaN if there is no solve [s].

    Raise NotReproducibleError if a command is not bitwise equal to the recorded command.
    """
    times, commands = np.empty((last - first, 2)), np.empty((last - first, 2))
    for k in range(first, last):
        t, measurement = float(run.time[k]), run.measurements[k]
        start = time.perf_counter()
        step = controller.step(t, measurement)
        times[k - first, 0] = time.perf_counter() - start
        times[k - first, 1] = step.solve_time
        commands[k - first] = step.command
    different_ticks = np.flatnonzero((commands != run.command[first:last]).any(axis=1))
    if different_ticks.size:
        k = first + different_ticks[0]
        raise NotReproducibleError(
            f"{run.reference.name}, t = {run.time[k]:.3f} s: the replay commanded {commands[k - first].tolist()}, but "
            f"the run {run.command[k].tolist()}: the controller is not deterministic"
        )
    return times
