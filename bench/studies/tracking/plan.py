"""Which runs the tracking study consists of."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from diffdrive_mpc.bench.case import NO_MODEL, Case, Overrides, combinations
from diffdrive_mpc.bench.controllers import check_cases
from diffdrive_mpc.bench.studies.tracking.settings import PARTS, Names, TrackingSettings
from diffdrive_mpc.bench.study import check_parts

BOUND = "clairvoyant"
"""Name of the controller that is the bound; it is no peer to choose on the command line."""
BOUND_NAME = "clairvoyant bound"
"""What tables and figures call it."""


@dataclass(frozen=True)
class TrackingPlan:
    """Cases by part. A case may belong to several parts; it is run once."""

    parts: dict[str, tuple[Case, ...]]

    @property
    def all(self) -> tuple[Case, ...]:
        """Every case once, in order."""
        return tuple(dict.fromkeys(itertools.chain.from_iterable(self.parts.values())))


def plan_study(study: TrackingSettings, only: Sequence[str] = PARTS) -> TrackingPlan:
    """List the cases of some parts of a study.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such part.
    """
    check_parts(only, PARTS)
    makers = {
        "targets": _targets,
        "ablation": _ablation,
        "cross": _cross,
        "surfaces": _surfaces,
        "scenarios": _scenarios,
        "bound": _bound,
    }
    return TrackingPlan({name: tuple(makers[name](study)) for name in PARTS if name in only})


def check_plan(plan: TrackingPlan) -> None:
    """Look whether every case can be run; raises ConfigError or ValueError if not."""
    check_cases(case for case in plan.all if case.controller != BOUND)


def overrides_of(values: dict[str, bool | int | float | str]) -> Overrides:
    """Configuration values as a case holds them."""
    return tuple(values.items())


def variants(study: TrackingSettings) -> dict[Overrides, str]:
    """Name of each variant of the ablation by the configuration values that make it, in order."""
    return {overrides_of(values): name for name, values in study.ablation.variants.items()}


def _cases(models: Names, trajectories: Names, seeds: Sequence[int], **places: Iterable[object]) -> list[Case]:
    """Every combination, trajectories and seeds varying fastest; a place that is not named is the default one."""
    first = {name: places.pop(name) for name in ("scenario", "overrides") if name in places}
    return combinations(**first, model=models, **places, trajectory=trajectories, seed=seeds)


def _targets(study: TrackingSettings) -> list[Case]:
    asked, every = study.targets, (study.models, study.trajectories, study.targets.seeds)
    return [
        *_cases(*every, surface=("default", *asked.untuned_surfaces)),
        *_cases(*every, sensors=(asked.late_sensors,)),
        *_cases(*every, scenario=asked.scenarios),
    ]


def _ablation(study: TrackingSettings) -> list[Case]:
    part = study.ablation
    return _cases(part.models, study.trajectories, part.seeds, overrides=variants(study), surface=part.surfaces)


def _cross(study: TrackingSettings) -> list[Case]:
    plants = [f"model:{name}" for name in study.cross.plants]
    return _cases(study.models, study.trajectories, study.cross.seeds, plant=plants)


def _surfaces(study: TrackingSettings) -> list[Case]:
    part = study.surfaces
    return _cases(study.models, study.trajectories, part.seeds, surface=part.surfaces, sensors=part.sensors)


def _scenarios(study: TrackingSettings) -> list[Case]:
    part = study.scenarios
    return _cases(study.models, part.trajectories, part.seeds, scenario=part.names)


def _bound(study: TrackingSettings) -> list[Case]:
    fixed = {"controller": [BOUND], "model": [NO_MODEL], "sensors": ["perfect"]}
    return combinations(**fixed, surface=study.bound.surfaces, trajectory=study.trajectories)
