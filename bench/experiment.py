"""Which cases an experiment consists of."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.bench.case import Case, Overrides, build, label
from diffdrive_mpc.bench.controllers import CONTROLLERS, NO_MODEL, PEERS
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.mpc import load_trajectory

Names = Annotated[tuple[str, ...], Field(min_length=1)]
Seed = Annotated[int, Field(ge=0)]
Steps = Annotated[int, Field(ge=1)]


class Experiment(StrictModel):
    """Dimensions of an experiment; every combination is a case."""

    controllers: Names
    models: Names
    trajectories: Names
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)]
    plants: Names
    surfaces: Names
    sensors: Names
    scenarios: Names
    horizons: tuple[Steps, ...] = Field((), description="horizons of the sweep [steps]; empty for none")
    config: str | None = Field(None, description="controller configuration file in place of the shipped ones")
    settings: tuple[Overrides, ...] = Field(((),), description="combinations of swept configuration values")


@dataclass(frozen=True)
class CasePlan:
    """Cases of an experiment. A case may belong to both parts; it is run once.

    Attributes
    ----------
    main
        Models x trajectories x seeds x plants x scenarios x settings.
    horizon
        Models x horizons x trajectories with the first seed, plant, surface, sensors, scenario and setting.
    """

    main: tuple[Case, ...]
    horizon: tuple[Case, ...]

    @property
    def all(self) -> tuple[Case, ...]:
        """Every case once, in order."""
        return tuple(dict.fromkeys((*self.main, *self.horizon)))


@cache
def default_experiment() -> Experiment:
    """Read what `bench` runs without options; raises ConfigError when the file has a mistake."""
    return load_checked(Experiment, Path(__file__).parent / "experiment.yaml")


def plan_cases(experiment: Experiment) -> CasePlan:
    """List the cases, after a check that everything they name exists and can be used.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError
        If a controller, model, trajectory, plant, surface, sensor set, scenario or configuration value cannot be used,
        or two of them would have the same name in tables and figures.
    """
    e = experiment
    unknown = [name for name in e.controllers if name not in CONTROLLERS]
    if unknown:
        raise ConfigError(f"unknown controller '{unknown[0]}'; known: {', '.join(CONTROLLERS)}")
    _check_labels(e)
    who = [pair for controller in e.controllers for pair in _drivers(controller, e)]
    where = list(itertools.product(e.plants, e.surfaces, e.sensors))
    main = [
        Case(controller, model, trajectory, *place, seed, e.config, overrides, scenario)
        for controller, model, overrides in who
        for place in where
        for scenario in e.scenarios
        for trajectory in e.trajectories
        for seed in e.seeds
    ]
    horizon = [
        _at_horizon(
            Case("mpc", model, trajectory, *where[0], e.seeds[0], e.config, e.settings[0], e.scenarios[0]), steps
        )
        for model in (e.models if "mpc" in e.controllers else ())
        for steps in e.horizons
        for trajectory in e.trajectories
    ]
    plan = CasePlan(tuple(main), tuple(horizon))
    _check(plan)
    return plan


def _drivers(controller: str, experiment: Experiment) -> list[tuple[str, str, Overrides]]:
    """Controller, model and overrides; a peer has neither model nor settings of ours."""
    if controller in PEERS:
        return [(controller, NO_MODEL, ())]
    return [(controller, model, overrides) for model in experiment.models for overrides in experiment.settings]


def _at_horizon(case: Case, steps: int) -> Case:
    """The case with another horizon, or itself where that is its own: equal cases run once."""
    return case if case.horizon == steps else case.with_override("horizon", steps)


def _check_labels(experiment: Experiment) -> None:
    """Refuse two files with the same stem in one dimension: tables and figures would merge them.

    A model stands under its name where a peer stands under its own; upper and lower case make no file of their own.
    """
    e = experiment
    peers = tuple(name for name in e.controllers if name in PEERS)
    dimensions = {
        "models": (*peers, *e.models) if "mpc" in e.controllers else peers,
        "trajectories": e.trajectories,
        "plants": e.plants,
        "surfaces": e.surfaces,
        "sensors": e.sensors,
        "scenarios": e.scenarios,
    }
    for dimension, names in dimensions.items():
        seen: dict[str, str] = {}
        for name in names:
            other = seen.setdefault(label(name).casefold(), name)
            if other != name:
                raise ConfigError(
                    f"{dimension}: '{other}' and '{name}' would both be '{label(name)}' in tables and figures; "
                    f"rename one file"
                )


def _check(plan: CasePlan) -> None:
    for trajectory in dict.fromkeys(case.trajectory for case in plan.all):
        load_trajectory(trajectory)
    pairs = {(c.controller, c.model, c.overrides, c.plant, c.surface, c.sensors, c.scenario): c for c in plan.all}
    for case in pairs.values():
        build(case)
