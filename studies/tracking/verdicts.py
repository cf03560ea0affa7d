"""Whether the runs reach what was asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.case import NO_SCENARIO
from diffdrive_mpc.bench.outcomes import by, count, mean, recoveries, worst
from studies.tracking.outcome import ReducedOutcome
from studies.tracking.settings import TrackingSettings, load_targets


@dataclass(frozen=True)
class Verdict:
    """One target, and how near each model comes.

    Attributes
    ----------
    what, where
        What is limited, with its unit, and on which runs.
    limit
        Largest value that is allowed.
    reached
        Value of each model; NaN where it could not be computed, which is not within any limit.
    """

    what: str
    where: str
    limit: float
    reached: dict[str, float]

    def met_by(self, model: str) -> bool:
        """Whether `model` stays within the limit."""
        return self.reached[model] <= self.limit

    @property
    def met(self) -> bool:
        """Whether every model does."""
        return all(self.met_by(model) for model in self.reached)


Outcomes = Sequence[ReducedOutcome]
Measure = Callable[[Outcomes], float]


def judge(outcomes: Outcomes, study: TrackingSettings) -> list[Verdict]:
    """Verdicts on everything that was asked for, from the outcomes of the part "targets"."""
    targets, asked = load_targets(), study.targets
    quiet = [one for one in outcomes if one.case.scenario == NO_SCENARIO]
    default = [one for one in quiet if (one.case.surface, one.case.sensors) == ("default", "default")]
    late = [one for one in quiet if one.case.sensors == asked.late_sensors]
    want, disturbed = targets.default, targets.disturbed
    verdicts = [
        _verdict("position RMSE [m]", "default", want.position_rmse, default, _mean("position_rmse_m")),
        _verdict("position RMSE [m], the aim", "default", want.position_aim, default, _mean("position_rmse_m")),
        _verdict("lateral error of the worst arc [m]", "default", want.arc_lateral, default, worst_arc),
        _verdict("course RMSE [rad]", "default", want.course_rmse, default, _mean("course_rmse_rad")),
        _verdict("heading RMSE [rad]", "default", want.heading_rmse, default, _mean("heading_rmse_rad")),
    ]
    for surface in asked.untuned_surfaces:
        there = [one for one in quiet if one.case.surface == surface]
        after = f"largest lateral after {targets.lateral_from:g} s [m]"
        verdicts += [
            _verdict("position RMSE [m]", surface, targets.untuned.position_rmse, there, _mean("position_rmse_m")),
            _verdict(after, surface, targets.untuned.lateral, there, _late_lateral),
        ]
    sensors = f"{asked.late_sensors} sensors"
    verdicts += [
        _verdict("runs not completed", sensors, 0, late, lambda group: len(group) - count(group, "completed")),
        _verdict("largest lateral [m]", sensors, targets.late.lateral, late, lambda g: worst(g, "lateral_max_m")),
        _verdict("fallbacks", sensors, 0, late, lambda group: count(group, "fallbacks")),
    ]
    for scenario in asked.scenarios:
        there = [one for one in outcomes if one.case.scenario == scenario]
        verdicts += [
            _verdict("longest recovery [s]", scenario, disturbed.recovery_time, there, _largest("recovery_time_s")),
            _verdict("largest overshoot [m]", scenario, disturbed.overshoot, there, _largest("overshoot_m")),
        ]
    return verdicts


def worst_arc(outcomes: Outcomes) -> float:
    """Largest, over the arcs of the trajectories, of the mean over seeds of |mean lateral error| [m]; NaN without."""
    arcs = [[one.arcs for one in group] for group in by("trajectory", outcomes).values()]
    means = [np.mean(np.abs(of_seeds), axis=0) for of_seeds in arcs if all(of_seeds)]
    return float(np.max(np.concatenate(means))) if means else math.nan


def _mean(metric: str) -> Measure:
    return lambda outcomes: mean(outcomes, metric)


def _largest(figure: str) -> Measure:
    return lambda outcomes: float(np.max(recoveries(outcomes, figure)))


def _late_lateral(outcomes: Outcomes) -> float:
    return max(one.late_lateral_m for one in outcomes)


def _verdict(what: str, where: str, limit: float, outcomes: Outcomes, measure: Measure) -> Verdict:
    return Verdict(what, where, limit, {model: float(measure(group)) for model, group in by("model", outcomes).items()})
