"""Runs of the study reduced to the numbers that tables and figures need: thousands of whole runs fill the memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.case import NO_SCENARIO, Case
from diffdrive_mpc.bench.controllers import controller_config, load_reference, run_case
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.outcomes import SolverShares, metrics_row, plain, who_drives
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.sim import Metrics, Run, make_plant, simulate
from diffdrive_mpc.sim.metrics.metrics import steady_arc_lateral, steady_arcs
from diffdrive_mpc.sim.metrics.recovery import Recovery
from studies.tracking.clairvoyant import ClairvoyantController
from studies.tracking.known_plant import know_plant
from studies.tracking.plan import BOUND, TrackingPlan
from studies.tracking.settings import TrackingSettings, load_targets

_DIGITS = 6
"""Of every number in `tracking.json`."""
_POINTS = 400
"""Ticks of a run that the page holds at most."""


@dataclass(frozen=True, eq=False)
class ReducedOutcome:
    """What is kept of a run; satisfies `bench.outcomes.Scored`.

    Attributes
    ----------
    case
        What was run.
    metrics
        Its statistics.
    recovery
        After a disturbance.
    shares
        Which way its solver took.
    arcs
        Mean lateral error of every steady arc [m].
    late_lateral_m
        Largest |lateral| after the first seconds; how many, `targets.yaml` says.
    time
        (n,) counted ticks [s].
    along, across
        (n,) position error against the reference at the same time, ahead of it and to the left of it [m].
    steady
        (n,) whether the tick belongs to a steady arc.
    series
        What the page shows of the run; None for most.
    """

    case: Case
    metrics: Metrics
    recovery: Recovery
    shares: SolverShares
    arcs: tuple[float, ...]
    late_lateral_m: float
    time: FloatArray
    along: FloatArray
    across: FloatArray
    steady: NDArray[np.bool_]
    series: Mapping[str, object] | None = None

    def as_json(self) -> dict[str, object]:
        """Labels and numbers as plain values, without step times and series; what is not finite is None."""
        values = self.case.as_row() | {"set": dict(self.case.overrides), "late_lateral_m": self.late_lateral_m}
        numbers = {"steady_arcs_m": self.arcs} | metrics_row(self, timed=False) | asdict(self.recovery)
        row: dict[str, object] = plain(values | numbers, _DIGITS)
        return row


@dataclass(frozen=True)
class TrackingResults:
    """What the study gave.

    Attributes
    ----------
    study
        What was asked for.
    parts
        Outcomes by part, in the order of the plan; parts that were left out are missing.
    """

    study: TrackingSettings
    parts: dict[str, tuple[ReducedOutcome, ...]]

    @property
    def all(self) -> tuple[ReducedOutcome, ...]:
        """Every outcome once, in order."""
        return tuple({one.case: one for part in self.parts.values() for one in part}.values())

    @property
    def plain(self) -> list[ReducedOutcome]:
        """Those of our controller as shipped, on the physics, with the default sensors and without disturbance."""
        return [one for one in self.all if is_plain(one.case)]


def is_plain(case: Case) -> bool:
    """Whether it is our controller as shipped, on the physics, with the default sensors and without disturbance."""
    usual = ("mujoco", "default", NO_SCENARIO, ())
    return case.controller != BOUND and (case.plant, case.sensors, case.scenario, case.overrides) == usual


def collect(study: TrackingSettings, plan: TrackingPlan, outcomes: Sequence[ReducedOutcome]) -> TrackingResults:
    """Outcomes in the order and the parts of the plan."""
    found = {one.case: one for one in outcomes}
    return TrackingResults(study, {name: tuple(found[case] for case in cases) for name, cases in plan.parts.items()})


def run_reduced(case: Case, trajectories: tuple[str, ...], *, with_series: bool = False) -> ReducedOutcome:
    """Run a case and reduce it.

    Parameters
    ----------
    case
        One of ours, or the bound.
    trajectories
        What the bound's knowledge of the plant is fitted on.
    with_series
        Whether the page shows it.
    """
    run = _run_bound(case, trajectories) if case.controller == BOUND else run_case(case)
    reduced = reduce_run(case, run)
    return replace(reduced, series=_series(case, run)) if with_series else reduced


def _series(case: Case, run: Run) -> Mapping[str, object]:
    model, path = who_drives(case), case.labels["trajectory"]
    config = controller_config(case.model, case.config, case.overrides)
    labels = {"model": model, "path": path}
    return run_series(run, f"{model}, {path}", points=_POINTS, labels=labels, config=config, every_layer=False)


def reduce_run(case: Case, run: Run) -> ReducedOutcome:
    """Keep of `run` what the study needs."""
    counted = np.flatnonzero(run.counted)
    offset = (run.true_pose - run.reference_pose)[counted]
    along, across = ahead_and_left(offset, run.reference_pose[counted, 2])
    steady = np.zeros(len(run.time), dtype=bool)
    for ticks in steady_arcs(run):
        steady[ticks] = True
    late = counted[run.time[counted] >= load_targets().lateral_from]
    return ReducedOutcome(
        case=case,
        metrics=run.metrics,
        recovery=run.recovery,
        shares=SolverShares.of(run),
        arcs=tuple(float(value) for value in steady_arc_lateral(run)),
        late_lateral_m=float(np.max(np.abs(run.errors.lateral[late]), initial=0.0)),
        time=run.time[counted],
        along=along,
        across=across,
        steady=steady[counted],
    )


def _run_bound(case: Case, trajectories: tuple[str, ...]) -> Run:
    known = know_plant(case.plant, case.surface, trajectories)
    controller = ClairvoyantController(known, controller_config(Case().model))
    plant = make_plant(case.plant, surface=case.surface, sensors=case.sensors, seed=case.seed)
    return simulate(controller, plant, load_reference(case))


@dataclass(frozen=True)
class ErrorParts:
    """Mean squares that add up to the mean squared position error [m^2].

    Attributes
    ----------
    bias
        Across the path, in steady arcs, the same for every seed: what slip and gains leave behind.
    transient
        Across the path, at all other times, the same for every seed: entries, exits, straights.
    along
        Along the path, the same for every seed.
    noise
        What differs from seed to seed: sensors.
    """

    bias: float
    transient: float
    along: float
    noise: float

    @property
    def total(self) -> float:
        """Mean squared position error [m^2]."""
        return self.bias + self.transient + self.along + self.noise


def decompose(outcomes: Sequence[ReducedOutcome]) -> ErrorParts:
    """Split the mean squared error of runs of one case that differ in their seeds.

    With S seeds the square of the mean over seeds still holds 1/S of the noise's variance; it is taken off there and
    counted as noise, so that both parts are unbiased and the sum stays exact. A single run has no noise to see: all of
    its error counts as repeated.

    Raises ValueError if the runs are of different length.
    """
    lengths = {len(one.time) for one in outcomes}
    if len(lengths) != 1:
        raise ValueError(f"runs of {sorted(lengths)} ticks cannot be compared tick by tick")
    across, along = (np.array([getattr(one, name) for one in outcomes]) for name in ("across", "along"))
    steady = outcomes[0].steady
    several = len(outcomes) > 1
    spread = [series.var(axis=0, ddof=1) if several else np.zeros(series.shape[1]) for series in (across, along)]
    repeated = [
        series.mean(axis=0) ** 2 - var / len(outcomes) for series, var in zip((across, along), spread, strict=True)
    ]
    return ErrorParts(
        bias=float(np.mean(np.where(steady, repeated[0], 0.0))),
        transient=float(np.mean(np.where(steady, 0.0, repeated[0]))),
        along=float(np.mean(repeated[1])),
        noise=float(np.mean(spread[0] + spread[1])),
    )
