"""P4's three scenarios: what a plan is worth whose slip law is none, that of another floor, or whose payload is new."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space import MovingDisc, Surroundings
from diffdrive_mpc_extras.planner import plan_each
from diffdrive_mpc_extras.terrain import Terrain, load_terrain, side_torques
from diffdrive_mpc_extras.torque import TorqueCurves
from diffdrive_mpc_extras.turn_costs import SlipCoefficients, TurnCosts, load_turn_costs
from diffdrive_mpc_extras.worlds.outline import plant_outline
from studies.saving.drives import PlanDrive, drive_closed, drive_open
from studies.saving.settings import PaperScenario, Place, Pose, Post, SavingStudySettings
from studies.torque.measurements import diagnostic_drive, plant_of, sides
from studies.torque.outcome import map_back
from studies.torque.settings import load_study as load_torque_study


class Planned(NamedTuple):
    """One plan of a scenario: for energy, driven open loop and by the controller, and for distance."""

    by: str
    """What the plan knew, in words"""
    open: PlanDrive
    closed: PlanDrive
    distance: PlanDrive
    """the distance-optimal plan of the same knowledge, by the controller"""
    gaps: tuple[float, float]
    """from the robot's outline to the nearest post [m], open loop and closed; negative: it touched it"""

    @property
    def saving(self) -> float:
        """Of the energy-optimal drive over the distance-optimal one, both by the controller [-]."""
        if not (self.closed.arrived and self.distance.arrived):
            return math.nan
        return 1 - self.closed.measured / self.distance.measured


class ScenarioOutcome(NamedTuple):
    """One scenario: what goes wrong, and what does not."""

    title: str
    figures: str
    """Of P4"""
    asked: PaperScenario
    plans: tuple[Planned, ...]

    @property
    def short(self) -> str:
        """What the title begins with, and the floor."""
        return f"{self.title.partition(':')[0].rpartition(' ')[2]}, '{self.asked.surface}'"


def measure_nominal(study: SavingStudySettings, scenario: PaperScenario) -> ScenarioOutcome:
    """Scenario 1: without slip, and with that of the floor; the power model is the floor's both times."""
    own = load_turn_costs(study.costs_of(scenario.surface))
    nominal = _with_slip(own, SlipCoefficients(), "no slip")
    plans = (
        _planned(study, scenario, nominal, "no slip"),
        _planned(study, scenario, own, f"slip of '{scenario.surface}'"),
    )
    return ScenarioOutcome(
        f"Scenario 1: on '{scenario.surface}', without slip and with it", "20 and 21", scenario, plans
    )


def measure_foreign(study: SavingStudySettings, scenario: PaperScenario) -> ScenarioOutcome:
    """Scenario 2: with the slip of another floor, and of its own; the power model is the floor's both times."""
    own, other = load_turn_costs(study.costs_of(scenario.surface)), load_turn_costs(study.costs_of(scenario.law))
    foreign = _with_slip(own, other.slip, f"slip of {scenario.law}")
    plans = (
        _planned(study, scenario, foreign, f"slip of '{scenario.law}'"),
        _planned(study, scenario, own, f"slip of '{scenario.surface}'"),
    )
    return ScenarioOutcome(
        f"Scenario 2: on '{scenario.surface}', with the slip of '{scenario.law}' and its own",
        "22 and 23",
        scenario,
        plans,
    )


def measure_loaded(study: SavingStudySettings, scenario: PaperScenario) -> ScenarioOutcome:
    """Scenario 3: a payload; torques as learned without one, and of the terrain that these were mapped to."""
    own = load_turn_costs(study.costs_of(scenario.surface))
    plans = (
        _planned(study, scenario, own, "torques as learned without payload"),
        _planned(study, scenario, loaded_costs(study, scenario, own), "torques of the terrain they were mapped to"),
    )
    title = f"Scenario 3: {scenario.payload:g} kg on '{scenario.surface}', learned without"
    return ScenarioOutcome(title, "24", scenario, plans)


def loaded_costs(study: SavingStudySettings, scenario: PaperScenario, own: TurnCosts) -> TurnCosts:
    """Turn costs under a payload, from a diagnostic drive without one: equation 24, then the shear law.

    The slip is that of the floor without payload. At the torque limit a turn asks for no more than the motors have.
    """
    torque = load_torque_study()
    vehicle = own.vehicle
    plant = plant_of(study.robot, scenario.surface, seed=torque.seed)
    drive = diagnostic_drive(plant, torque.diagnostic)
    curves = TorqueCurves.from_prior(vehicle, load_terrain(torque.prior))
    curves.learn_drive(drive.command, *sides(drive.motor_torque), plant.sample_time)
    speed = own.curve.speed
    ground = map_back(torque, vehicle, curves, speed).on(Terrain(description=scenario.surface))
    heavy = vehicle.carrying(scenario.payload)
    radii = np.array([one for one in own.curve.radius if one > 0.51 * (vehicle.command_track or vehicle.track)])
    torques = side_torques(heavy, ground, radii, speed)
    limit = vehicle.torque_limit
    outer, inner = (tuple(np.clip(side, -limit, limit).tolist()) for side in (torques.outer, torques.inner))
    curve = own.curve.model_copy(update={"radius": tuple(radii.tolist()), "outer": outer, "inner": inner})
    return TurnCosts(
        name=f"{own.name}, {scenario.payload:g} kg",
        vehicle=heavy,
        drive=own.drive,
        slip=own.slip,
        curve=curve,
        provenance=(
            f"terrain of '{scenario.surface}', mapped from a drive without payload, under {scenario.payload:g} kg"
        ),
    )


def _with_slip(own: TurnCosts, slip: SlipCoefficients, words: str) -> TurnCosts:
    """The same with another slip law; made anew, as a copy would keep what was worked out of the old values."""
    return TurnCosts(
        name=f"{own.name}, {words}",
        vehicle=own.vehicle,
        drive=own.drive,
        slip=slip,
        curve=own.curve,
        provenance=f"{own.provenance}; {words}",
    )


def gap_to_posts(path: FloatArray, posts: tuple[Post, ...], outline: tuple[float, float]) -> float:
    """Least distance [m] of a rectangle, length and width `outline` [m], at poses (n, 3) from posts.

    Negative where it lies over one: then by how far the post's edge is inside the nearest side.
    """
    least = math.inf
    cos, sin = np.cos(path[:, 2]), np.sin(path[:, 2])
    for x, y, radius in posts:
        dx, dy = x - path[:, 0], y - path[:, 1]
        ahead, left = np.abs(cos * dx + sin * dy) - outline[0] / 2, np.abs(cos * dy - sin * dx) - outline[1] / 2
        outside = np.hypot(np.maximum(ahead, 0.0), np.maximum(left, 0.0))
        within = np.minimum(np.maximum(ahead, left), 0.0)
        least = min(least, float((outside + within).min()) - radius)
    return least


def pose_of(place: Place) -> Pose:
    """With the heading in radians."""
    return place[0], place[1], math.radians(place[2])


def check_scenario(study: SavingStudySettings, scenario: PaperScenario) -> None:
    """Raise ConfigError where a name of it does not exist, or the goal or the start lies in a post."""
    for name in (scenario.surface, *((scenario.law,) if scenario.law else ())):
        load_turn_costs(study.costs_of(name))
    outline = plant_outline(f"mujoco:{study.robot}")
    for what in ("start", "goal"):
        if gap_to_posts(np.array([pose_of(getattr(scenario, what))]), scenario.posts, outline) <= 0:
            raise ConfigError(f"scenario on '{scenario.surface}': a post stands where the robot's {what} is; move it")


def _planned(study: SavingStudySettings, scenario: PaperScenario, costs: TurnCosts, by: str) -> Planned:
    start, goal = pose_of(scenario.start), pose_of(scenario.goal)
    around = Surroundings(discs=[MovingDisc(*post) for post in scenario.posts])
    plans = plan_each(costs, start, goal, speed=study.speed, obstacles=around, settings=study.planning.settings)
    cheapest, shortest = plans["energy"], plans["distance"]
    opened = drive_open(study, cheapest, scenario.surface, scenario.payload)
    closed = drive_closed(study, cheapest, scenario.surface, scenario.payload)
    outline = plant_outline(f"mujoco:{study.robot}")
    gaps = tuple(gap_to_posts(one.path, scenario.posts, outline) for one in (opened, closed))
    return Planned(
        by, opened, closed, drive_closed(study, shortest, scenario.surface, scenario.payload), (gaps[0], gaps[1])
    )
