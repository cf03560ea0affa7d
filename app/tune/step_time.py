"""The step time that a point would have on a machine that is named, from what it costs here beside the defaults.

Only processor time is read, of replays that take turns: what else runs on the machine hardly counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.app.tune.tune_file import StepTime
from diffdrive_mpc.bench.campaign.draws import Value
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller, run_case
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run

_SIZES = ("horizon", "solver.")
"""Keys of the configuration that decide how much a step computes."""
_TURNS = 5
"""So often each is replayed; of each tick the shortest counts."""
_PERCENTILE = 99.0


def sizes_of(values: Mapping[str, Value]) -> dict[str, Value]:
    """Those values of a point that its step time depends on."""
    return {key: value for key, value in values.items() if key.startswith(_SIZES)}


def predicted_p99(stated: StepTime, usual: Case, values: Mapping[str, Value]) -> float:
    """99th percentile of the step time of a point on the machine of `stated` [s].

    What is stated there for the defaults, times the ratio of the processor times here: each drives `usual` once, and
    both drives are replayed in turns.

    Parameters
    ----------
    stated
        Machine, and its figure for the defaults.
    usual
        A run of the defaults.
    values
        What the point has in place of values of their configuration.
    """
    point = usual
    for key, value in sizes_of(values).items():
        point = point.with_override(key, value)
    if point == usual:
        return stated.p99
    with threadpool_limits(limits=1):
        cases = (usual, point)
        drives = [run_case(case) for case in cases]
        turns = [[_processor_times(case, run) for case, run in zip(cases, drives, strict=True)] for _ in range(_TURNS)]
    theirs, mine = (np.percentile(np.min([turn[k] for turn in turns], axis=0), _PERCENTILE) for k in range(2))
    return float(stated.p99 * mine / theirs)


def _processor_times(case: Case, run: Run) -> FloatArray:
    """(ticks,) processor time of each step of a replay [s]."""
    controller = make_controller(case)
    controller.start(run.reference, float(run.time[0]))
    took = np.empty(len(run.time))
    for k, (t, measurement) in enumerate(zip(run.time.tolist(), run.measurements, strict=True)):
        began = thread_time()
        controller.step(t, measurement)
        took[k] = thread_time() - began
    return took
