"""Additional columns of a run, and the parts of errors over seeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame

from diffdrive_mpc.bench.case import NO_SCENARIO, Case
from diffdrive_mpc.bench.controllers import controller_config, load_reference, run_case
from diffdrive_mpc.bench.experiment import by
from diffdrive_mpc.bench.html_report.page import RunSeries
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.run_row import driver_name
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.sim import Run, make_plant, simulate
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE, ScoredRun
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

# Two twists closer than this [m/s, rad/s] are the same: a ramp changes by a hundred times as much in a sample.
_SAME_TWIST = 1e-6


def steady_arc_lateral(run: ScoredRun) -> FloatArray:
    """Compute the signed mean lateral error of every steady arc of the reference: positive to the left of the path.

    An arc is a stretch of constant twist with v and omega both other than zero. It is steady from `settled_arc` of
    `metrics.yaml` after its beginning until its end; shorter ones do not count.

    Returns
    -------
    FloatArray
        (number of steady arcs,) [m], in order of time.
    """
    return np.array([np.mean(run.errors.lateral[ticks]) for ticks in steady_arcs(run)])


def steady_arcs(run: ScoredRun) -> list[NDArray[np.intp]]:
    """Find the ticks of every steady arc, as `steady_arc_lateral` defines it, in order of time."""
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


BOUND = "clairvoyant"
"""Name of the controller that is the bound; it is no peer to choose on the command line."""
BOUND_NAME = "clairvoyant bound"
"""Name of the bound in tables and figures."""
MARGIN = "margin.omega"
"""Key that the part "margin" varies."""
_POINTS = 400
"""Ticks of a run that the page holds at most."""


class FigureTarget(StrictModel):
    """A figure of some runs, and its largest value that is allowed."""

    quantity: str
    place: str
    where: dict[str, str]
    figure: str
    limit: float


class Targets(StrictModel):
    """All results of the study."""

    lateral_from: float
    targets: tuple[FigureTarget, ...]


@cache
def load_targets() -> Targets:
    """Load the shipped targets."""
    return load_checked(Targets, Path(__file__).with_name("targets.yaml"))


def measured(case: Case, run: Run) -> dict[str, object]:
    """Compute the columns of a run.

    `arcs` (arcs,) are the mean lateral errors of every steady arc [m], `late_lateral_m` is the largest |lateral| after
    the first seconds of `targets.yaml`, `omega_change` the RMS change of omega_ref from tick to tick [rad/s], and
    `margin` that of omega where the case states it [s]. Over the counted ticks: `time` [s], `along` and `across` [m],
    the position error ahead of the reference and to its left, and `steady`, whether the tick belongs to a steady arc.
    `series` is what the page shows of a run as shipped with the usual floor and sensors.
    """
    counted = np.flatnonzero(run.counted)
    along, across = ahead_and_left((run.true_pose - run.reference_pose)[counted], run.reference_pose[counted, 2])
    steady = np.zeros(len(run.time), dtype=bool)
    for ticks in steady_arcs(run):
        steady[ticks] = True
    late = counted[run.time[counted] >= load_targets().lateral_from]
    return {
        "lost": not run.metrics.completed,
        "plain": is_plain(case),
        "arcs": np.array(steady_arc_lateral(run), dtype=float),
        "late_lateral_m": float(np.max(np.abs(run.errors.lateral[late]), initial=0.0)),
        "omega_change": float(np.sqrt(np.mean(np.diff(run.command[counted, 1]) ** 2))),
        "margin": dict(case.overrides).get(MARGIN, "-"),
        "time": run.time[counted],
        "along": along,
        "across": across,
        "steady": steady[counted],
        "series": _series(case, run) if is_plain(case) and case.surface == Case().surface else None,
    }


def is_plain(case: Case) -> bool:
    """Return True for our controller as shipped, on the physics, with default sensors and without disturbance."""
    usual = ("mujoco", "default", NO_SCENARIO, ())
    return case.controller == Case().controller and (case.plant, case.sensors, case.scenario, case.overrides) == usual


def _series(case: Case, run: Run) -> RunSeries:
    model, path = driver_name(case), case.labels["trajectory"]
    config = controller_config(case.model, case.config, case.overrides)
    labels = {"model": model, "path": path}
    return run_series(run, f"{model}, {path}", points=_POINTS, labels=labels, config=config)


def run_or_bound(trajectories: tuple[str, ...], case: Case) -> Run:
    """Drive a case; the bound's knowledge of its plant is fitted on `trajectories`."""
    if case.controller != BOUND:
        return run_case(case)
    from studies.tracking.clairvoyant import ClairvoyantController  # noqa: PLC0415 - loads slowly
    from studies.tracking.known_plant import know_plant  # noqa: PLC0415

    known = know_plant(case.plant, case.surface, trajectories)
    controller = ClairvoyantController(known, controller_config(Case().model))
    plant = make_plant(case.plant, surface=case.surface, sensors=case.sensors, seed=case.seed)
    return simulate(controller, plant, load_reference(case))


def worst_arc(rows: DataFrame) -> float:
    """Compute the maximum over arcs of the mean over seeds of |mean lateral error| [m]; NaN without arcs."""
    arcs = [list(group["arcs"]) for group in by(rows, "trajectory").values()]
    means = [np.mean(np.abs(of_seeds), axis=0) for of_seeds in arcs if all(len(of_seed) for of_seed in of_seeds)]
    return float(np.max(np.concatenate(means))) if means else math.nan


@dataclass(frozen=True)
class ErrorParts:
    """Mean squares that add up to the mean squared position error [m^2].

    Attributes
    ----------
    bias
        Across the path, in steady arcs, the same for every seed: the remaining effect of slip and gains.
    transient
        Across the path, at all other times, the same for every seed: entries, exits, straights.
    along
        Along the path, the same for every seed.
    noise
        Part that differs between the seeds, which the sensors cause.
    """

    bias: float
    transient: float
    along: float
    noise: float

    @property
    def total(self) -> float:
        """Mean squared position error [m^2]."""
        return self.bias + self.transient + self.along + self.noise


def decompose(rows: DataFrame) -> ErrorParts:
    """Split the mean squared error of runs of one case that differ in their seeds.

    With S seeds the square of the mean over seeds still holds 1/S of the noise's variance; it is taken off there and
    counted as noise, so that both parts are unbiased and the sum stays exact. A single run has no noise to see: all of
    its error counts as repeated.

    Raises ValueError if the runs are of different length.
    """
    lengths = {len(times) for times in rows["time"]}
    if len(lengths) != 1:
        raise ValueError(f"runs of {sorted(lengths)} ticks cannot be compared tick by tick")
    across, along = (np.stack(list(rows[name])) for name in ("across", "along"))
    steady, several = rows["steady"].iloc[0], len(rows) > 1
    spread = [series.var(axis=0, ddof=1) if several else np.zeros(series.shape[1]) for series in (across, along)]
    repeated = [series.mean(axis=0) ** 2 - var / len(rows) for series, var in zip((across, along), spread, strict=True)]
    return ErrorParts(
        bias=float(np.mean(np.where(steady, repeated[0], 0.0))),
        transient=float(np.mean(np.where(steady, 0.0, repeated[0]))),
        along=float(np.mean(repeated[1])),
        noise=float(np.mean(spread[0] + spread[1])),
    )
