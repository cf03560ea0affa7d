"""What the study `worlds` drives: its parts, from a YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.case import NO_MODEL, Case
from diffdrive_mpc.bench.controllers import build_plant, load_reference
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.plants.plant import RobotLostError
from diffdrive_mpc_extras.worlds.plug_in import world_record
from diffdrive_mpc_extras.worlds.sight import in_view
from diffdrive_mpc_extras.worlds.world import World
from diffdrive_mpc_extras.worlds.world_plant import WorldPlant

PARTS = ("drawn", "doorway", "crossing", "named")
Count = Annotated[int, Field(ge=1, le=100_000)]
Share = Annotated[float, Field(ge=0, le=1)]
Names = Annotated[tuple[str, ...], Field(min_length=1)]


class WorldCondition(StrictModel):
    """A robot on a floor, with sensors."""

    plant: str = "mujoco"
    surface: str = "default"
    sensors: str = "default"


class Doorway(StrictModel):
    """Runs through the doorway."""

    surfaces: Names
    sensors: Names
    seeds: Count


class CrossingRuns(StrictModel):
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
    conditions: Annotated[tuple[WorldCondition, ...], Field(min_length=1)]
    doorway: Doorway
    named: Names
    named_seeds: Count
    crossing: CrossingRuns


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
    ours = [controller for controller in controllers if controller not in PEERS]
    controllers = ours if ours and part not in settings.peers_in else controllers
    return [
        Case(
            controller=controller,
            model=NO_MODEL if controller in PEERS else model,
            plant=f"world:{world}@{where.plant}",
            surface=where.surface,
            sensors=where.sensors,
            seed=seed,
        )
        for world, where, seed in chosen
        for controller in controllers
    ]


def _places(settings: WorldsSettings, part: str, runs: int, first: int) -> list[tuple[str, WorldCondition, int]]:
    seeds = range(first, first + runs)
    if part == "drawn":
        conditions = settings.conditions
        return [
            (f"drawn:{seed}{_kind(settings.through, seed)}", conditions[(seed // 2) % len(conditions)], seed)
            for seed in seeds
        ]
    if part == "crossing":
        floors = [WorldCondition(surface=name) for name in settings.crossing.surfaces]
        return [(settings.crossing.world, floors[seed % len(floors)], seed) for seed in seeds]
    if part == "doorway":
        of = settings.doorway
        return [
            ("doorway", WorldCondition(surface=surface, sensors=sensors), first + seed)
            for seed in range(of.seeds)
            for surface in of.surfaces
            for sensors in of.sensors
        ]
    return [(world, WorldCondition(), first + seed) for seed in range(settings.named_seeds) for world in settings.named]


def _kind(share: float, seed: int) -> str:
    """Spread evenly over the seeds."""
    return ":through" if int((seed + 1) * share) > int(seed * share) else ""


# Whether a robot could have stopped before a person: the same run again, with brakes from when the person was known.


_LOOKS = 2
"""From so many looks on the motion of a person can be known: two places are a velocity."""
_AFTER = 0.5
"""The replay goes on for so long after the end of the run [s]."""


def known_at(world: World, time: FloatArray, pose: FloatArray) -> FloatArray:
    """(movers,) when the motion of each mover could be known to the controller [s]; infinite for never.

    Two looks in turn have had it in view, and the second of them has arrived. `time` (n,) and `pose` (n, 3) are those
    of a run.
    """
    sight = world.sight
    looks = np.arange(0.0, time[-1] + 1e-9, sight.period)
    ticks = np.minimum(np.searchsorted(time + 1e-9, looks), len(time) - 1)
    times = np.full(len(world.movers), np.inf)
    for i, mover in enumerate(world.movers):
        row = 0
        for k in ticks:
            row = row + 1 if in_view(mover, float(time[k]), pose[k], world.shapes(float(time[k])), sight) else 0
            if row == _LOOKS:
                times[i] = time[k] + sight.latency
                break
    return times


def stop_was_possible(case: Case, run: Run) -> bool | None:
    """Whether braking from when the persons were known would have touched nobody while moving.

    None where nobody could be known of before the end of the run: then there was nothing to stop for, or no chance.
    """
    known = known_at(world_record(run).world, run.time, run.true_pose)
    first = float(known.min(initial=np.inf))
    if not first <= run.time[-1]:
        return None
    plant = build_plant(case)
    assert isinstance(plant, WorldPlant)
    plant.reset(load_reference(case).sample([0.0]).pose[0])
    slew = load_robot().command_slew
    step = np.array([slew.v, slew.omega]) * plant.sample_time
    command = np.zeros(2)
    try:
        while plant.time < run.time[-1] + _AFTER:
            if plant.time < first:
                k = min(int(np.searchsorted(run.time, plant.time - 1e-9)), len(run.time) - 1)
                command = run.command[k]
            else:
                command = np.sign(command) * np.maximum(np.abs(command) - step, 0.0)
            plant.advance(command)
    except RobotLostError:
        return False
    return True
