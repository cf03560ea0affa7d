"""Robots without built-in models: a random population, and two robots with slow dynamics.

Controllers of a random robot are configured with data stated by its user, which are often wrong. For the other two
robots, models were identified from three drives each, and the peers were tuned on the robot with the same estimator.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from pathlib import Path

from diffdrive_mpc.bench.case import NO_MODEL, Case
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.sim.plants.names import DRAWN, PHYSICS

MODELS = Path(__file__).with_name("robots")
"""Identified models by robot and structure."""
PATHS = Path(__file__).with_name("paths")
"""Paths of the other robots."""


class Population(StrictModel):
    """Seeds, controllers and paths of the random robots."""

    robots: tuple[int, ...]
    trajectories: tuple[str, ...]
    controllers: tuple[str, ...]


class KnownRobot(StrictModel):
    """Robot of the plant `mujoco` with identified models.

    Attributes
    ----------
    models
        Structures with files in `MODELS`; the estimator of the peers uses the last model.
    settings
        Configuration values that the user states or `identify` has written.
    gains
        Gains of each peer.
    weights
        Weights of the predictive controller, tuned by the search that also tuned the gains.
    """

    models: tuple[str, ...]
    settings: dict[str, float]
    gains: dict[str, dict[str, float]]
    weights: dict[str, float]


class OtherRobots(StrictModel):
    """Content of `other_robots.yaml`."""

    population: Population
    trajectories: tuple[str, ...]
    seeds: tuple[int, ...]
    robots: dict[str, KnownRobot]


@cache
def other_robots() -> OtherRobots:
    """Read `other_robots.yaml`; raise ConfigError if it is invalid."""
    return load_checked(OtherRobots, Path(__file__).with_suffix(".yaml"))


def population_cases(*, whole: bool = False) -> tuple[Case, ...]:
    """Return the cases of all controllers on all random robots, with one trajectory per robot.

    If `whole` is True, every robot drives all trajectories.
    """
    content = other_robots().population
    paths = content.trajectories
    drives = [
        (trajectory, seed)
        for i, seed in enumerate(content.robots)
        for trajectory in (paths if whole else (paths[i % len(paths)],))
    ]
    return tuple(
        replace(_driver(name), trajectory=trajectory, plant=f"{DRAWN}:{seed}", seed=seed)
        for name, (trajectory, seed) in itertools.product(content.controllers, drives)
    )


def dynamics_cases(seeds: tuple[int, ...] | None = None) -> tuple[Case, ...]:
    """Return the cases of identified models and tuned peers on known robots; `seeds` replaces those of the file."""
    content, cases = other_robots(), []
    for name, robot in content.robots.items():
        files = {model: str(MODELS / name / f"{model}.yaml") for model in robot.models}
        settings = tuple(robot.settings.items())
        weights = tuple((f"weights.{error}", value) for error, value in robot.weights.items())
        drivers = [Case(model=file, overrides=(*settings, *weights)) for file in files.values()]
        drivers += [
            Case(
                controller=peer,
                model=NO_MODEL,
                overrides=(*settings, ("model", files[robot.models[-1]])),
                gains=tuple(gains.items()),
            )
            for peer, gains in robot.gains.items()
        ]
        paths = [str(PATHS / f"{trajectory}.yaml") for trajectory in content.trajectories]
        for driver, path, seed in itertools.product(drivers, paths, seeds or content.seeds):
            cases.append(replace(driver, plant=f"{PHYSICS}:{name}", trajectory=path, seed=seed))
    return tuple(cases)


def _driver(name: str) -> Case:
    """Return a case with the peer `name`, or with the model `name` in the predictive controller."""
    return Case(controller=name, model=NO_MODEL) if name in PEERS else Case(model=name)
