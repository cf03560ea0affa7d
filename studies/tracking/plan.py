"""Which runs the tracking study consists of."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from diffdrive_mpc.bench.case import DIMENSIONS, NO_MODEL, NO_SCENARIO, Case, Overrides, combinations
from diffdrive_mpc.bench.controllers import check_cases
from diffdrive_mpc.bench.study import check_parts
from diffdrive_mpc.models.checked_yaml import StrictModel
from studies.tracking.settings import PARTS, TrackingSettings

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
    """List the cases of some parts of a study; raises ConfigError if there is no such part."""
    check_parts(only, PARTS)
    makers: dict[str, Callable[[TrackingSettings], list[Case]]] = {
        "targets": _targets,
        "ablation": lambda s: _cases(s, s.ablation, overrides=variants(s)),
        "cross": _cross,
        "surfaces": lambda s: _cases(s, s.surfaces),
        "scenarios": lambda s: _cases(s, s.scenarios, scenario=s.scenarios.names),
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


def _cases(study: TrackingSettings, part: StrictModel, **more: Iterable[object]) -> list[Case]:
    """Every combination of the dimensions that a part names, with the study's models and trajectories by default."""
    named = {one.name: getattr(part, one.several) for one in DIMENSIONS if hasattr(part, one.several)} | more
    slow = {name: named.pop(name) for name in ("scenario", "overrides") if name in named}
    fast = {"trajectory": named.pop("trajectory", study.trajectories), "seed": named.pop("seed")}
    return combinations(**slow, **{"model": study.models, **named}, **fast)


def _targets(study: TrackingSettings) -> list[Case]:
    asked = study.targets
    return [
        *_cases(study, asked, scenario=[NO_SCENARIO], surface=("default", *asked.untuned_surfaces)),
        *_cases(study, asked, scenario=[NO_SCENARIO], sensors=[asked.late_sensors]),
        *_cases(study, asked),
    ]


def _cross(study: TrackingSettings) -> list[Case]:
    return _cases(study, study.cross, plant=[f"model:{name}" for name in study.cross.plants])


def _bound(study: TrackingSettings) -> list[Case]:
    fixed = {"controller": [BOUND], "model": [NO_MODEL], "sensors": ["perfect"]}
    return combinations(**fixed, surface=study.bound.surfaces, trajectory=study.trajectories)
