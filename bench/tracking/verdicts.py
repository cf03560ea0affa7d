"""Whether the runs reach what was asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.tracking.row import Row
from diffdrive_mpc.bench.tracking.study import Study
from diffdrive_mpc.bench.tracking.targets import load_targets


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


Measure = Callable[[Sequence[Row]], float]


def judge(rows: Sequence[Row], study: Study) -> list[Verdict]:
    """Verdicts on everything that was asked for, from the rows of the part "targets"."""
    targets, asked = load_targets(), study.targets
    quiet = [row for row in rows if row.case.scenario == "none"]
    default = [row for row in quiet if (row.case.surface, row.case.sensors) == ("default", "default")]
    late = [row for row in quiet if row.case.sensors == asked.late_sensors]
    want = targets.default
    verdicts = [
        _verdict("position RMSE [m]", "default", want.position_rmse, default, mean_of("position_rmse_m")),
        _verdict("position RMSE [m], the aim", "default", want.position_aim, default, mean_of("position_rmse_m")),
        _verdict("lateral error of the worst arc [m]", "default", want.arc_lateral, default, worst_arc),
        _verdict("course RMSE [rad]", "default", want.course_rmse, default, mean_of("course_rmse_rad")),
        _verdict("heading RMSE [rad]", "default", want.heading_rmse, default, mean_of("heading_rmse_rad")),
    ]
    for surface in asked.untuned_surfaces:
        there = [row for row in quiet if row.case.surface == surface]
        after = f"largest lateral after {targets.lateral_from:g} s [m]"
        verdicts += [
            _verdict("position RMSE [m]", surface, targets.untuned.position_rmse, there, mean_of("position_rmse_m")),
            _verdict(after, surface, targets.untuned.lateral, there, _largest(lambda row: row.late_lateral_m)),
        ]
    lateral = _largest(lambda row: row.metrics.lateral_max_m)
    sensors = f"{asked.late_sensors} sensors"
    verdicts += [
        _verdict("runs not completed", sensors, 0, late, not_completed),
        _verdict("largest lateral [m]", sensors, targets.late.lateral, late, lateral),
        _verdict("fallbacks", sensors, 0, late, lambda group: sum(row.metrics.fallbacks for row in group)),
    ]
    for scenario in asked.scenarios:
        there, limits = [row for row in rows if row.case.scenario == scenario], targets.disturbed
        recovery = _largest(lambda row: row.recovered.recovery_time_s)
        overshoot = _largest(lambda row: row.recovered.overshoot_m)
        verdicts += [
            _verdict("longest recovery [s]", scenario, limits.recovery_time, there, recovery),
            _verdict("largest overshoot [m]", scenario, limits.overshoot, there, overshoot),
        ]
    return verdicts


def mean_of(metric: str) -> Measure:
    """Mean over runs of a field of `sim.metrics.metrics.Metrics`; NaN where one run could not compute it."""
    return lambda rows: float(np.mean([getattr(row.metrics, metric) for row in rows]))


def worst_arc(rows: Iterable[Row]) -> float:
    """Largest, over the arcs of the trajectories, of the mean over seeds of |mean lateral error| [m]; NaN without."""
    by_trajectory: dict[str, list[tuple[float, ...]]] = {}
    for row in rows:
        by_trajectory.setdefault(row.case.trajectory, []).append(row.arcs)
    means = [np.mean(np.abs(arcs), axis=0) for arcs in by_trajectory.values() if all(arcs)]
    return float(np.max(np.concatenate(means))) if means else math.nan


def not_completed(rows: Sequence[Row]) -> float:
    """How many runs did not reach their end."""
    return float(sum(not row.metrics.completed for row in rows))


def _largest(value: Callable[[Row], float]) -> Measure:
    return lambda rows: float(np.max([value(row) for row in rows]))


def _verdict(what: str, where: str, limit: float, rows: Sequence[Row], measure: Measure) -> Verdict:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.case.labels["model"], []).append(row)
    return Verdict(what, where, limit, {model: float(measure(group)) for model, group in groups.items()})
