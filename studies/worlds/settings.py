"""What the study `worlds` drives: its parts, from a YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.bench.case import NO_MODEL, Case
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

PARTS = ("drawn", "doorway", "crossing", "named")
Count = Annotated[int, Field(ge=1, le=100_000)]
Share = Annotated[float, Field(ge=0, le=1)]
Names = Annotated[tuple[str, ...], Field(min_length=1)]


class Condition(StrictModel):
    """A robot on a floor, with sensors."""

    plant: str = "mujoco"
    surface: str = "default"
    sensors: str = "default"


class Doorway(StrictModel):
    """Runs through the doorway."""

    surfaces: Names
    sensors: Names
    seeds: Count


class Crossing(StrictModel):
    """Runs in which somebody crosses."""

    world: str
    surfaces: Names


class WorldsSettings(StrictModel):
    """Everything in `settings.yaml`."""

    runs: Count = Field(description="drawn worlds, and crossings")
    through: Share = Field(description="share of drawn worlds in which posts stand on the planned way")
    peers_in: tuple[Literal["drawn", "doorway", "crossing", "named"], ...] = Field(
        description="parts that peers drive beside the predictive controller; alone they drive all"
    )
    conditions: Annotated[tuple[Condition, ...], Field(min_length=1)]
    doorway: Doorway
    named: Names
    named_seeds: Count
    crossing: Crossing


def load_settings() -> WorldsSettings:
    """The shipped settings."""
    return load_checked(WorldsSettings, Path(__file__).parent / "settings.yaml")


def cases(
    settings: WorldsSettings, part: str, controllers: Sequence[str], model: str, runs: int | None, first: int = 0
) -> list[Case]:
    """The runs of a part: worlds are the same for all controllers.

    Parameters
    ----------
    settings, part
        What is driven.
    controllers, model
        Who drives, and the model of the predictive one.
    runs
        How many drawn worlds and crossings; of the others at most so many. None for those of the settings.
    first
        The first seed.
    """
    placed = _places(settings, part, settings.runs if runs is None else runs, first)
    chosen = placed if runs is None else placed[:runs]
    ours = [one for one in controllers if one not in PEERS]
    controllers = ours if ours and part not in settings.peers_in else controllers
    return [
        Case(
            controller=one,
            model=NO_MODEL if one in PEERS else model,
            world=world,
            seed=seed,
            **where.model_dump(),
        )
        for world, where, seed in chosen
        for one in controllers
    ]


def _places(settings: WorldsSettings, part: str, runs: int, first: int) -> list[tuple[str, Condition, int]]:
    seeds = range(first, first + runs)
    if part == "drawn":
        conditions = settings.conditions
        return [
            (f"drawn:{seed}{_kind(settings.through, seed)}", conditions[(seed // 2) % len(conditions)], seed)
            for seed in seeds
        ]
    if part == "crossing":
        floors = [Condition(surface=name) for name in settings.crossing.surfaces]
        return [(settings.crossing.world, floors[seed % len(floors)], seed) for seed in seeds]
    if part == "doorway":
        of = settings.doorway
        return [
            ("doorway", Condition(surface=surface, sensors=sensors), first + seed)
            for seed in range(of.seeds)
            for surface in of.surfaces
            for sensors in of.sensors
        ]
    return [(world, Condition(), first + seed) for seed in range(settings.named_seeds) for world in settings.named]


def _kind(share: float, seed: int) -> str:
    """Spread evenly over the seeds."""
    return ":through" if int((seed + 1) * share) > int(seed * share) else ""
