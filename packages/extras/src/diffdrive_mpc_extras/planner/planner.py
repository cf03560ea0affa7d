"""Function `plan`: a timed reference from pose to pose with minimum energy, time or distance."""

from __future__ import annotations

from numpy.typing import ArrayLike

from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc_extras.free_space import Footprint, Surroundings
from diffdrive_mpc_extras.planner.clearance import Clearance, allowed_radius, build_free_map, check_request, outline
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
    """Plan the reference from `start` to `goal` with minimum energy, time or distance.

    Sampling-based A* over inputs finds the shape, IPOPT optimises it locally, and forward integration of the sampled
    commands checks end pose, limits and clearance. The result does not depend on the clock, so it is reproducible.

    Parameters
    ----------
    costs
        Motion and cost of the robot on its surface.
    start, goal
        (3,) poses x, y [m], theta [rad].
    via
        (n, 2) via points x, y [m] in order, with any heading.
    minimise
        Objective: "energy", "time" or "distance".
    speed
        Commanded speed on straights and wide turns [m/s]; by default that of the torque table.
    obstacles
        Polygons and discs to avoid; None for no obstacles.
    footprint
        Footprint of the robot; by default the rectangle that contains wheels and tyres.
    reverse
        True to allow driving backwards.
    on_the_spot
        True to allow turns on the spot.
    sample_time
        Sample time of the commands [s]; by default that of the robot of the papers.
    settings
        Settings of the planner; by default the shipped ones.

    Raises
    ------
    PlanError
        If a pose, the speed or the objective is invalid, or if there is no plan.
    mpc.free_space.SurroundingsError
        If an obstacle is invalid.
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
    """Plan for all objectives, in little more time than for one; parameters and errors as in `plan`."""
    task = _task(
        costs, start, goal, via, "energy", speed, obstacles, footprint, reverse, on_the_spot, sample_time, settings
    )
    shapes = task.searches()
    candidates = task.candidates(shapes)
    return {objective: task.best(objective, shapes, candidates) for objective in OBJECTIVES}


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
    start_pose, end, between = check_request(start, goal, via, minimise, cruise, dt)
    sharp = allowed_radius(costs, cruise, plan_settings)
    clearance = None if obstacles is None else Clearance(obstacles, footprint or outline(costs.vehicle))
    if clearance is not None and clearance.empty:
        clearance = None
    free = build_free_map(clearance, start_pose, end, between, plan_settings)
    return Task(
        costs, start_pose, end, between, cruise, sharp, clearance, free, reverse, on_the_spot, dt, plan_settings
    )
