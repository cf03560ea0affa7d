"""Additional columns of a run, and the decomposition of errors over seeds."""

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

# Difference below which two twists are equal [m/s, rad/s]; a ramp changes by a hundred times as much in a sample.
_SAME_TWIST = 1e-6


def steady_arc_lateral(run: ScoredRun) -> FloatArray:
    """Compute the signed mean lateral error of every steady arc of the reference, positive to the left of the path.

    An arc is an interval of constant twist with nonzero v and omega. Its steady part starts `settled_arc` of
    `metrics.yaml` after its start; shorter arcs are omitted.

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
"""Name of the controller of the bound; it is no peer on the command line."""
BOUND_NAME = "clairvoyant bound"
"""Name of the bound in tables and figures."""
MARGIN = "margin.omega"
"""Configuration key that the part "margin" varies."""
_POINTS = 400
"""Maximum number of ticks of a run on the page."""


class FigureTarget(StrictModel):
    """A figure of selected runs, and its limit."""

    quantity: str
    place: str
    where: dict[str, str]
    figure: str
    limit: float


class Targets(StrictModel):
    """Content of `targets.yaml`."""

    lateral_from: float
    targets: tuple[FigureTarget, ...]


@cache
def load_targets() -> Targets:
    """Load the shipped targets."""
    return load_checked(Targets, Path(__file__).with_name("targets.yaml"))


def additional_columns(case: Case, run: Run) -> dict[str, object]:
    """Compute the columns of a run.

    `arcs` (arcs,) are the mean lateral errors of every steady arc [m]. `late_lateral_m` is the maximum |lateral| error
    after `lateral_from` of `targets.yaml` [m]. `omega_change` is the RMS change of omega_ref per tick [rad/s]. `margin`
    is the margin of omega if the case overrides it [s]. Over the counted ticks: `time` [s], the position error `along`
    (ahead of) and `across` (left of) the reference [m], and `steady`, True in steady arcs. `series` is the view of a
    run with the shipped configuration on the default surface, else None.
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
    """Return True for our controller as shipped, on the physics plant, with default sensors and no disturbance."""
    usual = ("mujoco", "default", NO_SCENARIO, ())
    return case.controller == Case().controller and (case.plant, case.sensors, case.scenario, case.overrides) == usual


def _series(case: Case, run: Run) -> RunSeries:
    model, path = driver_name(case), case.labels["trajectory"]
    config = controller_config(case.model, case.config, case.overrides)
    labels = {"model": model, "path": path}
    return run_series(run, f"{model}, {path}", points=_POINTS, labels=labels, config=config)


def run_or_bound(trajectories: tuple[str, ...], case: Case) -> Run:
    """Run a case; the plant data of the bound are fitted on `trajectories`."""
    if case.controller != BOUND:
        return run_case(case)
    from studies.tracking.clairvoyant import ClairvoyantController  # noqa: PLC0415 - loads slowly
    from studies.tracking.known_plant import identify_plant  # noqa: PLC0415

    known = identify_plant(case.plant, case.surface, trajectories)
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
        Error across the path in steady arcs, equal for all seeds: the remaining effect of slip and gains.
    transient
        Error across the path at other times, equal for all seeds: entries, exits, straights.
    along
        Error along the path, equal for all seeds.
    noise
        Error that differs between the seeds, which is caused by the sensors.
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
    """Split the mean squared error of runs that differ only in their seeds.

    With S seeds, the square of the mean over seeds contains 1/S of the variance of the noise. This part is subtracted
    there and counted as noise, so that both parts are unbiased and their sum is exact. With a single run, the noise is
    unknown, and the whole error counts as repeated.

    Raises ValueError if the runs have different lengths.
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
