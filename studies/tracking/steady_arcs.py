"""The lateral error of a run on the steady arcs of its reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE, ScoredRun
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

# Two twists closer than this [m/s, rad/s] are the same: a ramp changes by a hundred times as much in a sample.
_SAME_TWIST = 1e-6


def steady_arc_lateral(run: ScoredRun) -> FloatArray:
    """Mean lateral error of every steady arc of the reference, signed: positive to the left of the path.

    An arc is a stretch of constant twist with v and omega both other than zero. It is steady from `settled_arc` of
    `metrics.yaml` after its beginning until its end; shorter ones do not count.

    Returns
    -------
    FloatArray
        (number of steady arcs,) [m], in order of time.
    """
    return np.array([np.mean(run.errors.lateral[ticks]) for ticks in steady_arcs(run)])


def steady_arcs(run: ScoredRun) -> list[NDArray[np.intp]]:
    """The ticks of every steady arc, as `steady_arc_lateral` defines it, in order of time."""
    ticks = np.flatnonzero(run.counted)
    twist, time = run.reference_twist[ticks], run.time[ticks]
    changed = 1 + np.flatnonzero((np.abs(np.diff(twist, axis=0)) > _SAME_TWIST).any(axis=1))
    arcs = []
    for stretch in np.split(np.arange(len(ticks)), changed):
        curved = bool((np.abs(twist[stretch[0]]) > _SAME_TWIST).all())
        steady = stretch[time[stretch] >= time[stretch[0]] + metric_settings().settled_arc - TIME_TOLERANCE]
        if curved and steady.size:
            arcs.append(ticks[steady])
    return arcs
