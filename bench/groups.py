"""Outcomes put together by what they share, and the means over them that tables and figures show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from diffdrive_mpc.bench.runner import Outcome
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import MODEL_NAMES


def mean(outcomes: Iterable[Outcome], field: str) -> float:
    """Mean of one metric over runs; NaN where one of them could not compute it."""
    return float(np.mean([getattr(outcome.run.metrics, field) for outcome in outcomes]))


def worst(outcomes: Iterable[Outcome], field: str) -> float:
    """Largest value of one metric over runs."""
    return float(np.max([getattr(outcome.run.metrics, field) for outcome in outcomes]))


def recoveries(outcomes: Iterable[Outcome], field: str) -> FloatArray:
    """(runs,) one figure of the recovery from the disturbance."""
    return np.array([getattr(outcome.run.recovery, field) for outcome in outcomes])


def step_times(outcomes: Iterable[Outcome]) -> FloatArray:
    """Step times of all counted ticks of several runs [s]."""
    return np.concatenate([outcome.run.step_time[outcome.run.counted] for outcome in outcomes])


def groups(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes by what is compared: controller and model, and place, sensors, scenario and settings where they vary.

    The names of a dimension that does not vary are left out, and so is "mpc" beside the name of its model.
    """
    varying = [
        name for name in ("plant", "surface", "sensors", "scenario") if len({o.case.labels[name] for o in outcomes}) > 1
    ]
    several = len({outcome.case.overrides for outcome in outcomes if outcome.case.controller == "mpc"}) > 1
    grouped: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        labels = outcome.case.labels
        parts = [model_name(outcome) if labels["controller"] == "mpc" else labels["controller"]]
        parts += [labels[name] for name in varying]
        parts += [f"{key}={value}" for key, value in outcome.case.overrides] if several else []
        grouped.setdefault(", ".join(parts), []).append(outcome)
    return grouped


def model_name(outcome: Outcome) -> str:
    """Name of the model as the papers write it, or that of the user's file."""
    name = outcome.case.labels["model"]
    return name.upper() if name in MODEL_NAMES else name


def by_model(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes by model, in the order of their first appearance."""
    grouped: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        grouped.setdefault(model_name(outcome), []).append(outcome)
    return grouped


def by_trajectory(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes by trajectory, in the order of their first appearance."""
    grouped: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        grouped.setdefault(outcome.case.labels["trajectory"], []).append(outcome)
    return grouped


def by_scenario(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes by scenario, in the order of their first appearance."""
    grouped: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        grouped.setdefault(outcome.case.labels["scenario"], []).append(outcome)
    return grouped


def by_horizon(outcomes: Sequence[Outcome]) -> dict[int, list[Outcome]]:
    """Outcomes of predictive controllers by horizon, shortest first."""
    grouped: dict[int, list[Outcome]] = {}
    for outcome in outcomes:
        if outcome.case.horizon is not None:
            grouped.setdefault(outcome.case.horizon, []).append(outcome)
    return dict(sorted(grouped.items()))
