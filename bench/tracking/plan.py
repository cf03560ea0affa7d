"""Which runs the tracking study consists of."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from diffdrive_mpc.bench.case import NO_SCENARIO, Case, Overrides, build
from diffdrive_mpc.bench.controllers import NO_MODEL
from diffdrive_mpc.bench.tracking.study import PARTS, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import load_trajectory

BOUND = "clairvoyant"
"""Name of the controller that is the bound; it is no peer to choose on the command line."""
DEFAULT, PERFECT, PHYSICS = "default", "perfect", "mujoco"


@dataclass(frozen=True)
class StudyPlan:
    """Cases by part. A case may belong to several parts; it is run once."""

    parts: dict[str, tuple[Case, ...]]

    @property
    def all(self) -> tuple[Case, ...]:
        """Every case once, in order."""
        return tuple(dict.fromkeys(itertools.chain.from_iterable(self.parts.values())))


def plan_study(study: Study, only: Sequence[str] = PARTS) -> StudyPlan:
    """List the cases of some parts of a study.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such part.
    """
    unknown = [name for name in only if name not in PARTS]
    if unknown:
        raise ConfigError(f"--only: unknown part '{unknown[0]}'; known: {', '.join(PARTS)}")
    makers = {
        "targets": _targets,
        "ablation": _ablation,
        "cross": _cross,
        "surfaces": _surfaces,
        "scenarios": _scenarios,
        "bound": _bound,
    }
    return StudyPlan({name: tuple(makers[name](study)) for name in PARTS if name in only})


def check_plan(plan: StudyPlan) -> None:
    """Build every controller, plant and trajectory of a plan once.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError
        If one of them does not exist or cannot be used.
    """
    for trajectory in dict.fromkeys(case.trajectory for case in plan.all):
        load_trajectory(trajectory)
    ours = [case for case in plan.all if case.controller != BOUND]
    # Whether a controller or a plant can be built does not depend on the other.
    by_controller = {(case.model, case.overrides): case for case in ours}
    by_plant = {(case.plant, case.surface, case.sensors, case.scenario): case for case in ours}
    for case in dict.fromkeys((*by_controller.values(), *by_plant.values())):
        build(case)


def overrides_of(values: dict[str, bool | int | float | str]) -> Overrides:
    """Configuration values as a case holds them."""
    return tuple(values.items())


def _cases(
    models: Sequence[str],
    trajectories: Sequence[str],
    seeds: Sequence[int],
    *,
    plants: Sequence[str] = (PHYSICS,),
    surfaces: Sequence[str] = (DEFAULT,),
    sensors: Sequence[str] = (DEFAULT,),
    overrides: Sequence[Overrides] = ((),),
    scenarios: Sequence[str] = (NO_SCENARIO,),
) -> list[Case]:
    dimensions = (scenarios, overrides, models, plants, surfaces, sensors, trajectories, seeds)
    return [
        Case("mpc", model, trajectory, plant, surface, sensor_set, seed, None, changed, scenario)
        for scenario, changed, model, plant, surface, sensor_set, trajectory, seed in itertools.product(*dimensions)
    ]


def _targets(study: Study) -> list[Case]:
    asked, every = study.targets, (study.models, study.trajectories, study.targets.seeds)
    return [
        *_cases(*every, surfaces=(DEFAULT, *asked.untuned_surfaces)),
        *_cases(*every, sensors=(asked.late_sensors,)),
        *_cases(*every, scenarios=asked.scenarios),
    ]


def _ablation(study: Study) -> list[Case]:
    part = study.ablation
    variants = [overrides_of(values) for values in part.variants.values()]
    return _cases(part.models, study.trajectories, part.seeds, surfaces=part.surfaces, overrides=variants)


def _cross(study: Study) -> list[Case]:
    plants = [f"model:{name}" for name in study.cross.plants]
    return _cases(study.models, study.trajectories, study.cross.seeds, plants=plants)


def _surfaces(study: Study) -> list[Case]:
    part = study.surfaces
    return _cases(study.models, study.trajectories, part.seeds, surfaces=part.surfaces, sensors=part.sensors)


def _scenarios(study: Study) -> list[Case]:
    part = study.scenarios
    return _cases(study.models, part.trajectories, part.seeds, scenarios=part.names)


def _bound(study: Study) -> list[Case]:
    places = itertools.product(study.bound.surfaces, study.trajectories)
    return [Case(BOUND, NO_MODEL, trajectory, PHYSICS, surface, PERFECT, 0) for surface, trajectory in places]
