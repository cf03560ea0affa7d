"""Step times: recorded measurements replayed through a fresh controller, serially, on one core.

Runs are recorded in parallel, where neighbours disturb the clock. The replay also proves determinism: it must give the
same commands bit for bit.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller
from diffdrive_mpc.bench.errors import NotReproducibleError
from diffdrive_mpc.bench.outcomes import Outcome
from diffdrive_mpc.bench.runner import OnDone
from diffdrive_mpc.models.interface import FloatArray, TrackingController
from diffdrive_mpc.sim import Run

_WARM_UP_TICKS = 25


@contextmanager
def quiet_core() -> Iterator[None]:
    """One core (where the system lets a process choose), one BLAS thread, no garbage collection; undone at the end."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    collecting = gc.isenabled()
    with threadpool_limits(limits=1):
        if cores:
            os.sched_setaffinity(0, {max(cores)})
        gc.collect()
        gc.freeze()  # what exists by now need not be searched again between runs
        gc.disable()
        try:
            yield
        finally:
            gc.unfreeze()
            if collecting:
                gc.enable()
            if cores:
                os.sched_setaffinity(0, cores)


def time_outcomes(outcomes: Sequence[Outcome], on_done: OnDone) -> tuple[list[Outcome], float]:
    """Replace the step times by those of a serial pass on one quiet core.

    Returns
    -------
    outcomes
        With the new step times.
    share
        Processor time over elapsed time of the pass; well below 1, other programs had the core at times, and the
        upper percentiles are theirs.

    Raises NotReproducibleError if a replay commanded something else than the run.
    """
    timed = []
    with quiet_core():
        elapsed, used = time.perf_counter(), time.thread_time()
        for outcome in outcomes:
            run = outcome.run.with_step_time(time_steps(outcome.case, outcome.run))
            timed.append(Outcome(outcome.case, run))
            on_done()
        share = (time.thread_time() - used) / (time.perf_counter() - elapsed)
    return timed, share


def time_steps(case: Case, run: Run) -> FloatArray:
    """Step times (n,) [s] of a fresh controller for `case` that gets the measurements of `run`.

    Another instance takes a few steps first, so that imports and one-time costs do not count. Call within
    `quiet_core`.

    Raises NotReproducibleError if a command differs from the recorded one in any bit.
    """
    replay(make_controller(case), run, min(_WARM_UP_TICKS, len(run.time)))
    gc.collect()
    return replay(make_controller(case), run, len(run.time))


def replay(controller: TrackingController, run: Run, ticks: int) -> FloatArray:
    """Give `controller` the first `ticks` measurements of `run` again and time its steps, (ticks,) [s].

    Raises NotReproducibleError if a command differs from the recorded one in any bit.
    """
    took, commands = np.empty(ticks), np.empty((ticks, 2))
    controller.start(run.reference, float(run.time[0]))
    for k in range(ticks):
        t, measurement = float(run.time[k]), run.measurements[k]
        began = time.perf_counter()
        step = controller.step(t, measurement)
        took[k] = time.perf_counter() - began
        commands[k] = step.command
    differs = np.flatnonzero((commands != run.command[:ticks]).any(axis=1))
    if differs.size:
        k = differs[0]
        raise NotReproducibleError(
            f"{run.reference.name}, t = {run.time[k]:.3f} s: the replay commanded {commands[k].tolist()}, the run "
            f"{run.command[k].tolist()}: the controller is not deterministic"
        )
    return took
