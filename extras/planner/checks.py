"""What a plan is asked for: refused in one sentence where it cannot be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.extras.planner.clearance import Clearance, ClearanceMap
from diffdrive_mpc.extras.planner.inputs import OBJECTIVES, sharpest_radius
from diffdrive_mpc.extras.planner.settings import PlanSettings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.turn_costs import TurnCosts

_FARTHEST = 1e4
_SAME_PLACE, _SAME_HEADING = 1e-3, 1e-3


class PlanError(ConfigError):
    """There is no such plan. The message is one line: what is in the way, with its figures, and the remedy."""


def checked(
    start: ArrayLike, goal: ArrayLike, via: ArrayLike, minimise: str, speed: float, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Start (3,), goal (3,) and via points (n, 2) as numbers; raises PlanError where something cannot be used."""
    if minimise not in OBJECTIVES:
        raise PlanError(f"minimise '{minimise}': give {', '.join(OBJECTIVES[:-1])} or {OBJECTIVES[-1]}")
    if not (math.isfinite(speed) and speed > 0):
        raise PlanError(f"speed {speed} m/s: give a positive number")
    if not (math.isfinite(dt) and dt > 0):
        raise PlanError(f"sample time {dt} s: give a positive number")
    poses = []
    for name, given in (("start", start), ("goal", goal)):
        pose = np.asarray(given, dtype=float)
        if pose.shape != (3,) or not np.isfinite(pose).all() or np.abs(pose).max() > _FARTHEST:
            raise PlanError(f"{name} {np.ravel(pose).tolist()}: give x, y [m] and theta [rad], finite numbers")
        poses.append(pose)
    points = np.asarray(via, dtype=float).reshape(-1, 2) if np.size(via) % 2 == 0 else np.full((1, 2), np.nan)
    if not np.isfinite(points).all() or (points.size and np.abs(points).max() > _FARTHEST):
        raise PlanError("via: give x, y [m] of each point, finite numbers")
    begin, end = poses
    turn = math.remainder(float(end[2] - begin[2]), 2 * math.pi)
    if not len(points) and math.dist(begin[:2], end[:2]) < _SAME_PLACE and abs(turn) < _SAME_HEADING:
        raise PlanError(f"start and goal are the same, {words_of(begin)}: there is nothing to drive")
    stops = np.concatenate([begin[None, :2], points, end[None, :2]])
    close = np.hypot(*np.diff(stops, axis=0).T) < _SAME_PLACE
    if len(points) and close.any():
        raise PlanError(f"via: point {int(np.argmax(close)) + 1} is where the one before it is; leave one out")
    return begin, end, points


def allowed_radius(costs: TurnCosts, speed: float, settings: PlanSettings) -> float:
    """Least radius [m]; raises PlanError where the robot cannot turn, or not even drive, so fast."""
    if speed > settings.motion.top_speed:
        raise PlanError(
            f"speed {speed:g} m/s: at most {settings.motion.top_speed:g} m/s (motion.top_speed); go slower, or give "
            "settings for a faster robot"
        )
    straight = np.abs(costs.torques([[speed, 0.0]])).max()
    if straight >= costs.vehicle.torque_limit:
        raise PlanError(f"speed {speed:g} m/s: the motors cannot drive it straight on; go slower")
    sharp = sharpest_radius(costs, speed, settings)
    if not math.isfinite(sharp):
        raise PlanError(f"speed {speed:g} m/s: every turn needs more torque than the motors have; go slower")
    return sharp


def free_map(
    clearance: Clearance | None, begin: FloatArray, end: FloatArray, via: FloatArray, settings: PlanSettings
) -> tuple[ClearanceMap, float] | None:
    """The map for the search; raises PlanError where start, goal or a via point is not free."""
    if clearance is None:
        return None
    margin = settings.motion.margin
    for name, pose in (("start", begin), ("goal", end)):
        room = float(clearance.of_poses(pose[None])[0])
        if room < margin:
            where = "overlaps an obstacle" if room < 0 else f"is {room:.2f} m from an obstacle"
            raise PlanError(
                f"{name} {words_of(pose)}: the robot {where} there, at least {margin:g} m are asked for; move the "
                f"{name}, or take a smaller margin"
            )
    for i, point in enumerate(via):
        headings = np.column_stack([np.tile(point, (16, 1)), np.linspace(-np.pi, np.pi, 16)])
        if (clearance.of_poses(headings) < margin).all():
            raise PlanError(
                f"via {i + 1} ({point[0]:g}, {point[1]:g}): the robot is less than {margin:g} m from an obstacle there "
                "in every heading; move the point, or take a smaller margin"
            )
    points = np.concatenate([begin[None, :2], via, end[None, :2]])
    asked = settings.search
    return ClearanceMap(clearance, points, asked.map_room, asked.map_cell), margin


def words_of(pose: Sequence[float] | FloatArray) -> str:
    """A pose for a sentence."""
    return f"({pose[0]:g}, {pose[1]:g}, {math.degrees(pose[2]):.0f} deg)"
