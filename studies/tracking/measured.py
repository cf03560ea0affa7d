"""Additional columns of a run, targets, and decomposition of the errors of runs with different seeds."""

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

_TWIST_TOLERANCE = 1e-6
"""Difference below which two twists count as equal [m/s, rad/s]; ramps change by a hundred times more per sample."""


def steady_arc_lateral(run: ScoredRun) -> FloatArray:
    """Compute the mean lateral error of every steady arc of the reference, positive to the left of the path.

    An arc is an interval of constant twist with nonzero v and omega. The steady part of an arc starts `settled_arc`
    (see `metrics.yaml`) after the start of the arc; shorter arcs are omitted.

    Returns
    -------
    FloatArray
        Errors (number of steady arcs,) [m], in order of time.
    """
    return np.array([np.mean(run.errors.lateral[ticks]) for ticks in steady_arcs(run)])


def steady_arcs(run: ScoredRun) -> list[NDArray[np.intp]]:
    """Find the ticks of every steady arc in order of time; `steady_arc_lateral` defines the arcs."""
    ticks = np.flatnonzero(run.counted)
    twist, time = run.reference_twist[ticks], run.time[ticks]
    changes = 1 + np.flatnonzero((np.abs(np.diff(twist, axis=0)) > _TWIST_TOLERANCE).any(axis=1))
    arcs = []
    for arc in np.split(np.arange(len(ticks)), changes):
        is_curved = bool((np.abs(twist[arc[0]]) > _TWIST_TOLERANCE).all())
        steady = arc[time[arc] >= time[arc[0]] + metric_settings().settled_arc - TIME_TOLERANCE]
        if is_curved and steady.size:
            arcs.append(ticks[steady])
    return arcs


BOUND = "clairvoyant"
"""Name of the clairvoyant controller in an experiment, which is not available on the command line."""
BOUND_NAME = "clairvoyant bound"
"""Name of the bound in tables and figures."""
MARGIN = "margin.omega"
"""Key of the configuration that the part "margin" of the study varies."""
_POINTS = 400
"""Maximum number of ticks of a run in the charts of the page."""


class FigureTarget(StrictModel):
    """Limit of a statistic of the runs that `where` selects; `targets.yaml` describes the fields."""

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
    """Load `targets.yaml`; raise ConfigError if the file is invalid."""
    return load_checked(Targets, Path(__file__).with_name("targets.yaml"))


def additional_columns(case: Case, run: Run) -> dict[str, object]:
    """Compute the additional columns of a run.

    `lost` is True if the run was not completed, and `plain` is the result of `is_plain`. `arcs` (arcs,) are the mean
    lateral errors of the steady arcs [m]. `late_lateral_m` is the maximum |lateral| error after `lateral_from` of
    `targets.yaml` [m]. `omega_change` is the RMS change of omega_ref per tick [rad/s]. `margin` is the margin of omega
    [s] if the case overrides it, otherwise "-". `time` [s], the position errors `along` and `across` [m], which are
    positive ahead and to the left of the reference, and the flag `steady` of steady arcs have one value per counted
    tick. `series` are the charts of a run with the shipped configuration on the default surface, otherwise None.
    """
    counted = np.flatnonzero(run.counted)
    along, across = ahead_and_left((run.true_pose - run.reference_pose)[counted], run.reference_pose[counted, 2])
    steady = np.zeros(len(run.time), dtype=bool)
    for ticks in steady_arcs(run):
        steady[ticks] = True
    late_ticks = counted[run.time[counted] >= load_targets().lateral_from]
    return {
        "lost": not run.metrics.completed,
        "plain": is_plain(case),
        "arcs": np.array(steady_arc_lateral(run), dtype=float),
        "late_lateral_m": float(np.max(np.abs(run.errors.lateral[late_ticks]), initial=0.0)),
        "omega_change": float(np.sqrt(np.mean(np.diff(run.command[counted, 1]) ** 2))),
        "margin": dict(case.overrides).get(MARGIN, "-"),
        "time": run.time[counted],
        "along": along,
        "across": across,
        "steady": steady[counted],
        "series": _series(case, run) if is_plain(case) and case.surface == Case().surface else None,
    }


def is_plain(case: Case) -> bool:
    """Return True for the shipped controller on the physics plant with default sensors and without a scenario."""
    default = ("mujoco", "default", NO_SCENARIO, ())
    return case.controller == Case().controller and (case.plant, case.sensors, case.scenario, case.overrides) == default


def _series(case: Case, run: Run) -> RunSeries:
    model, path = driver_name(case), case.labels["trajectory"]
    config = controller_config(case.model, case.config, case.overrides)
    labels = {"model": model, "path": path}
    return run_series(run, f"{model}, {path}", points=_POINTS, labels=labels, config=config)


def run_or_bound(trajectories: tuple[str, ...], case: Case) -> Run:
    """Run a case; for the bound, the plant is identified on `trajectories`."""
    if case.controller != BOUND:
        return run_case(case)
    from studies.tracking.clairvoyant import ClairvoyantController  # noqa: PLC0415 - loads slowly
    from studies.tracking.known_plant import identify_plant  # noqa: PLC0415

    plant_data = identify_plant(case.plant, case.surface, trajectories)
    controller = ClairvoyantController(plant_data, controller_config(Case().model))
    plant = make_plant(case.plant, surface=case.surface, sensors=case.sensors, seed=case.seed)
    return simulate(controller, plant, load_reference(case))


def worst_arc(rows: DataFrame) -> float:
    """Return the maximum over arcs of the mean |lateral error| over seeds [m], or NaN if no run has arcs."""
    arcs = [list(group["arcs"]) for group in by(rows, "trajectory").values()]
    means = [np.mean(np.abs(seed_rows), axis=0) for seed_rows in arcs if all(len(seed_arcs) for seed_arcs in seed_rows)]
    return float(np.max(np.concatenate(means))) if means else math.nan


@dataclass(frozen=True)
class ErrorParts:
    """Parts of the mean squared position error [m^2].

    Attributes
    ----------
    bias
        Repeated error across the path in steady arcs, caused by slip and gains.
    transient
        Repeated error across the path at all other times.
    along
        Repeated error along the path.
    noise
        Variance of the error over seeds, caused by the noise of the sensors.
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

    The repeated error is the mean over seeds. With S seeds, its square contains 1/S of the variance of the noise. This
    part is subtracted from the repeated error and added to the noise, so that both are unbiased and their sum is exact.
    With a single run, the noise is unknown, and the whole error counts as repeated.

    Raise ValueError if the runs have different numbers of ticks.
    """
    lengths = {len(times) for times in rows["time"]}
    if len(lengths) != 1:
        raise ValueError(f"runs of {sorted(lengths)} ticks cannot be compared: all runs need the same number of ticks")
    across, along = (np.stack(list(rows[name])) for name in ("across", "along"))
    steady, seeds = rows["steady"].iloc[0], len(rows)
    noise = [series.var(axis=0, ddof=1) if seeds > 1 else np.zeros(series.shape[1]) for series in (across, along)]
    repeated = [series.mean(axis=0) ** 2 - var / seeds for series, var in zip((across, along), noise, strict=True)]
    return ErrorParts(
        bias=float(np.mean(np.where(steady, repeated[0], 0.0))),
        transient=float(np.mean(np.where(steady, 0.0, repeated[0]))),
        along=float(np.mean(repeated[1])),
        noise=float(np.mean(noise[0] + noise[1])),
    )
