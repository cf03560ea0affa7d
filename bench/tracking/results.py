"""The rows of a study by part, and means over them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.case import NO_SCENARIO, Case
from diffdrive_mpc.bench.tracking.plan import BOUND, DEFAULT, PHYSICS, StudyPlan
from diffdrive_mpc.bench.tracking.row import Row
from diffdrive_mpc.bench.tracking.study import Study


@dataclass(frozen=True)
class StudyResults:
    """What a study gave.

    Attributes
    ----------
    study
        What was asked for.
    parts
        Rows by part, in the order of the plan; parts that were left out are missing.
    meta
        Machine, versions, definitions.
    """

    study: Study
    parts: dict[str, tuple[Row, ...]]
    meta: dict[str, object]

    @property
    def all(self) -> tuple[Row, ...]:
        """Every row once, in order."""
        return tuple({row.case: row for rows in self.parts.values() for row in rows}.values())

    @property
    def plain(self) -> tuple[Row, ...]:
        """Rows of our controller as shipped, on the physics, with the default sensors and without disturbance."""
        return tuple(
            row
            for row in self.all
            if row.case.controller != BOUND
            and (row.case.plant, row.case.sensors, row.case.scenario) == (PHYSICS, DEFAULT, NO_SCENARIO)
            and not row.case.overrides
        )

    def as_json(self) -> dict[str, object]:
        """`{"meta": ..., "runs": [...]}` of plain values."""
        return {"meta": self.meta, "runs": [row.as_json() for row in self.all]}


def collect(study: Study, plan: StudyPlan, rows: dict[Case, Row], meta: dict[str, object]) -> StudyResults:
    """Rows in the order and the parts of the plan."""
    return StudyResults(study, {name: tuple(rows[case] for case in cases) for name, cases in plan.parts.items()}, meta)


def group(rows: Iterable[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    """Rows by a label, in the order of first appearance."""
    grouped: dict[str, list[Row]] = {}
    for row in rows:
        grouped.setdefault(key(row), []).append(row)
    return grouped


def mean(rows: Iterable[Row], metric: str) -> float:
    """Mean of one field of `sim.metrics.metrics.Metrics` over runs; NaN without runs."""
    values = [getattr(row.metrics, metric) for row in rows]
    return float(np.mean(values)) if values else float("nan")
