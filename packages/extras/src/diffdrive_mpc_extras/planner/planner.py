"""`plan`: a timed reference from pose to pose that takes the least energy, time or distance."""

from __future__ import annotations

from numpy.typing import ArrayLike

from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc_extras.free_space import Footprint, Surroundings
from diffdrive_mpc_extras.planner.clearance import Clearance, allowed_radius, checked, free_map, outline
from diffdrive_mpc_extras.planner.inputs import OBJECTIVES, Objective
from diffdrive_mpc_extras.planner.result import Plan
from diffdrive_mpc_extras.planner.settings import PlanSettings, load_plan_settings
from diffdrive_mpc_extras.planner.task import Task
from diffdrive_mpc_extras.turn_costs import TurnCosts


def plan(
    costs: TurnCosts,
    start: ArrayLike,
    goal: ArrayLike,
    via: ArrayLike = (),
    minimise: Objective = "energy",
    *,
    speed: float | None = None,
    obstacles: Surroundings | None = None,
    footprint: Footprint | None = None,
    reverse: bool = False,
    on_the_spot: bool = False,
    sample_time: float | None = None,
    settings: PlanSettings | None = None,
) -> Plan:
    """Plan the reference from `start` to `goal` with the least energy, time or distance.

    Sampling-based A* over inputs finds the shape, IPOPT makes it smooth and as cheap as its neighbourhood allows, and
    forward integration of the sampled commands proves end, limits and clearance. The same plan comes out on every
    machine: nothing depends on the clock.

    Parameters
    ----------
    costs
        The robot on its floor.
    start, goal
        (3,) x, y [m], theta [rad].
    via
        (n, 2) x, y [m] to pass in this order, with any heading.
    minimise
        "energy", "time" or "distance".
    speed
        Commanded on straights and gentle turns [m/s]; by default that of the torque table.
    obstacles
        Polygons and discs to keep clear of; None for nothing.
    footprint
        By default the rectangle over wheels and tyres.
    reverse
        Whether it may drive backward.
    on_the_spot
        Whether it may turn on the spot.
    sample_time
        Sample time of the commands [s]; by default that of the robot of the papers.
    settings
        By default the shipped ones.

    Raises
    ------
    PlanError
        If a pose, the speed or the objective cannot be used, or there is no such way.
    mpc.free_space.SurroundingsError
        If an obstacle cannot be used.
    """
    task = _task(
        costs, start, goal, via, minimise, speed, obstacles, footprint, reverse, on_the_spot, sample_time, settings
    )
    shapes = task.searches()
    return task.best(minimise, shapes, task.candidates(shapes))


def plan_each(
    costs: TurnCosts,
    start: ArrayLike,
    goal: ArrayLike,
    via: ArrayLike = (),
    *,
    speed: float | None = None,
    obstacles: Surroundings | None = None,
    footprint: Footprint | None = None,
    reverse: bool = False,
    on_the_spot: bool = False,
    sample_time: float | None = None,
    settings: PlanSettings | None = None,
) -> dict[Objective, Plan]:
    """Plan for every objective, in little more time than for one; parameters and errors as in `plan`."""
    task = _task(
        costs, start, goal, via, "energy", speed, obstacles, footprint, reverse, on_the_spot, sample_time, settings
    )
    shapes = task.searches()
    made = task.candidates(shapes)
    return {objective: task.best(objective, shapes, made) for objective in OBJECTIVES}


def _task(
    costs: TurnCosts,
    start: ArrayLike,
    goal: ArrayLike,
    via: ArrayLike,
    minimise: str,
    speed: float | None,
    obstacles: Surroundings | None,
    footprint: Footprint | None,
    reverse: bool,
    on_the_spot: bool,
    sample_time: float | None,
    settings: PlanSettings | None,
) -> Task:
    plan_settings = settings or load_plan_settings()
    dt = load_robot().sample_time if sample_time is None else sample_time
    cruise = costs.curve.speed if speed is None else speed
    start_pose, end, between = checked(start, goal, via, minimise, cruise, dt)
    sharp = allowed_radius(costs, cruise, plan_settings)
    clearance = None if obstacles is None else Clearance(obstacles, footprint or outline(costs.vehicle))
    if clearance is not None and clearance.empty:
        clearance = None
    free = free_map(clearance, start_pose, end, between, plan_settings)
    return Task(
        costs, start_pose, end, between, cruise, sharp, clearance, free, reverse, on_the_spot, dt, plan_settings
    )
