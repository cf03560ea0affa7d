"""What runs come to: the objective over that of the defaults, its two sides, and by how much constraints are broken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import thread_time
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from diffdrive_mpc.app.tune.tune_file import Constraint, Figure, Objective, StepTime, Weighted
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import make_controller, run_case
from diffdrive_mpc.bench.statistics import cvar, mean
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import Run
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.proof.report import is_unsafe

Side = Literal["error", "effort"]
_FIGURES = {"mean": mean, "cvar": cvar}


@dataclass(frozen=True)
class ObjectiveTerm:
    """One figure of the objective; `weight` is its share of the whole [-]."""

    side: Side
    column: str
    figure: Figure
    weight: float

    def of(self, values: FloatArray) -> FloatArray:
        """The figure of (..., runs) values, along the last axis."""
        return np.asarray(_FIGURES[self.figure](values, axis=-1), dtype=float)


@dataclass(frozen=True)
class ObjectiveScore:
    """The objective of a point and its parts, each 1 for the defaults on the same runs [-].

    Attributes
    ----------
    value
        All terms by their weights.
    error, effort
        The terms of each side by their weights; effort is NaN where the objective has none.
    """

    value: FloatArray
    error: FloatArray
    effort: FloatArray


def terms_of(objective: Objective) -> list[ObjectiveTerm]:
    """All terms, error first; their weights add up to 1."""
    sides: dict[Side, Weighted] = {"error": objective.error, "effort": objective.effort}
    listed = [
        (side, column, figure, weight)
        for side, columns in sides.items()
        for column, figures in columns.items()
        for figure, weight in figures.items()
    ]
    total = sum(weight for *_, weight in listed)
    return [ObjectiveTerm(side, column, figure, weight / total) for side, column, figure, weight in listed]


def table_of(terms: Sequence[ObjectiveTerm], driven: Sequence[CampaignRun]) -> FloatArray:
    """(terms, runs) what each term is a figure of; NaN where a run has no such value."""
    return np.array([[run.number(term.column) for run in driven] for term in terms])


def score(terms: Sequence[ObjectiveTerm], table: FloatArray, usual: FloatArray) -> ObjectiveScore:
    """Score of a table (terms, ..., runs) beside that of the defaults, of the same shape."""
    weights = np.array([term.weight for term in terms])
    ratios = np.array([term.of(mine) / term.of(theirs) for term, mine, theirs in zip(terms, table, usual, strict=True)])

    def of_side(side: Side) -> FloatArray:
        chosen = np.array([term.side == side for term in terms])
        part = np.tensordot(weights[chosen], ratios[chosen], 1)
        return np.asarray(part / weights[chosen].sum() if chosen.any() else np.full_like(part, np.nan))

    return ObjectiveScore(np.asarray(np.tensordot(weights, ratios, 1)), of_side("error"), of_side("effort"))


def check_usual(terms: Sequence[ObjectiveTerm], table: FloatArray) -> None:
    """Raise ConfigError if the defaults have no figure that others could be held against."""
    for term, values in zip(terms, table, strict=True):
        figure = float(term.of(values))
        if not (np.isfinite(figure) and figure > 0.0):
            raise ConfigError(
                f"objective.{term.side}.{term.column}: its {term.figure} is {figure:g} with the configuration as it "
                "is; leave it out, or drive runs that have it"
            )


def broken(
    driven: Sequence[CampaignRun], usual: Sequence[CampaignRun], terms: Sequence[ObjectiveTerm]
) -> dict[str, float]:
    """What must hold of every point, by name: above zero where it does not.

    No unsafe command, every run driven with all values of the objective, and no more runs that do not complete than the
    defaults have.
    """
    return {
        "unsafe": float(sum(map(is_unsafe, driven))),
        "not_driven": float(np.count_nonzero(~np.isfinite(table_of(terms, driven)).all(axis=0))),
        "not_completed": float(_lost(driven) - _lost(usual)),
    }


def exceeded(constraint: Constraint, driven: Sequence[CampaignRun], usual: Sequence[CampaignRun], name: str) -> float:
    """By which share of its limit the largest value of a constraint's column is beyond it; 0 or less where it holds.

    Runs without such a value do not count. Raises ConfigError if none of the defaults' has one.
    """
    theirs, mine = _largest(constraint.column, usual), _largest(constraint.column, driven)
    if not np.isfinite(theirs):
        raise ConfigError(
            f"constraints.{name}: no run with the configuration as it is has {constraint.column}; an overshoot needs a "
            "scenario, in its factors"
        )
    limit = constraint.at_most if constraint.at_most is not None else float(constraint.times or 1.0) * theirs
    if not np.isfinite(mine):
        return 1.0
    return (mine - limit) / abs(limit) if limit else mine


def in_words(violations: Mapping[str, float]) -> str:
    """Names of what does not hold, with commas; empty where all does."""
    return ", ".join(name.replace("_", " ") for name, value in violations.items() if value > 0.0)


def _lost(driven: Sequence[CampaignRun]) -> int:
    return sum(run.row["completed"] is not True for run in driven)


def _largest(column: str, driven: Sequence[CampaignRun]) -> float:
    values = np.array([run.number(column) for run in driven])
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


# The step time that a point would have on a machine that is named, from what it costs here beside the defaults.


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
