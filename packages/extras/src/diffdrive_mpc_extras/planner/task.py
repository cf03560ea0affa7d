"""Planning task: search shapes, optimise each, check it by forward integration, and select the best."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.timed_poses import fit_timed_poses
from diffdrive_mpc_extras.planner.clearance import Clearance, ClearanceMap, PlanError, pose_text
from diffdrive_mpc_extras.planner.inputs import OBJECTIVES, Objective, make_inputs, spot_rate
from diffdrive_mpc_extras.planner.polish import polish
from diffdrive_mpc_extras.planner.result import (
    POLISHED,
    SEARCHED,
    UNFINISHED,
    Plan,
    integrate_commands,
    match_goal,
    sample_commands,
)
from diffdrive_mpc_extras.planner.schedule import Schedule, build_schedule
from diffdrive_mpc_extras.planner.search import PlanSearch, PlanSearchResult
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts

# Tolerances of a plan for its end [m, rad], the limits (ratio), and the via points [m].
_END_TOLERANCE, _EXCESS, _VIA_TOLERANCE = 1e-4, 5e-3, 0.02
_EQUAL = 1e-4


@dataclass(frozen=True, eq=False)
class Task:
    """Checked request with its derived data.

    Attributes
    ----------
    costs
        Motion and cost of the robot on its surface.
    start, goal
        (3,) poses.
    via
        (n, 2) via points.
    speed
        Speed [m/s].
    sharpest
        Minimum commanded radius [m].
    clearance, free
        Exact distances to the obstacles, and the map for the search; None for no obstacles.
    reverse, on_the_spot
        True to allow driving backwards and turns on the spot.
    sample_time
        Sample time [s].
    settings
        Settings of the planner.
    """

    costs: TurnCosts
    start: FloatArray
    goal: FloatArray
    via: FloatArray
    speed: float
    sharpest: float
    clearance: Clearance | None
    free: tuple[ClearanceMap, float] | None
    reverse: bool
    on_the_spot: bool
    sample_time: float
    settings: PlanSettings

    def searches(self) -> dict[Objective, PlanSearchResult]:
        """Search the best shape for each objective; raises PlanError if there is none."""
        paths: dict[Objective, PlanSearchResult] = {}
        for objective in OBJECTIVES:
            search = self._search(objective, self.free)
            if not paths and not search.reachable():
                wide = 2 * float(self.clearance.robot[0, 2]) if self.clearance is not None else 0.0
                raise PlanError(
                    f"goal {pose_text(self.goal)}: obstacles block all paths for a robot {wide:.2f} m wide with "
                    f"{self.settings.motion.margin:g} m on each side; use a smaller margin or another goal"
                )
            shape = search.run()
            if shape is not None:
                paths[objective] = shape
        if not paths:
            raise PlanError(
                f"goal {pose_text(self.goal)}: no path was found in {self.settings.search.most_states:,} states with "
                f"a minimum radius of {self.sharpest:.2f} m; {self._remedies()}"
            )
        self._check_detour(paths)
        return paths

    def candidates(self, shapes: dict[Objective, PlanSearchResult]) -> list[Plan]:
        """Optimise each shape for its objective; raises PlanError if no result is valid."""
        candidates, faults = [], []
        for objective, shape in shapes.items():
            try:
                candidates.append(self._optimise(objective, shape))
            except PlanError as error:
                faults.append(error)
        if not candidates:
            raise faults[0]
        return candidates

    def best(self, minimise: Objective, shapes: dict[Objective, PlanSearchResult], candidates: list[Plan]) -> Plan:
        """Return the best plan; if the best shape is that of another objective, also optimise it for `minimise`."""
        minimum = min(candidate.amount(minimise) for candidate in candidates)
        # Prefer the candidate that was optimised for this objective.
        equal = [candidate for candidate in candidates if candidate.amount(minimise) <= minimum * (1 + _EQUAL)]
        best = next((candidate for candidate in equal if candidate.minimise == minimise), equal[0])
        if best.minimise != minimise:
            with suppress(PlanError):
                best = min(best, self._optimise(minimise, shapes[best.minimise]), key=lambda row: row.amount(minimise))
        return best.for_objective(minimise, shapes.get(minimise, best.search))

    def _search(self, objective: Objective, free: tuple[ClearanceMap, float] | None) -> PlanSearch:
        inputs = make_inputs(
            self.costs, objective, self.speed, self.settings, reverse=self.reverse, spot=self.on_the_spot
        )
        return PlanSearch(inputs, self.start, self.goal, self.via, self.settings.search, free)

    def _check_detour(self, paths: dict[Objective, PlanSearchResult]) -> None:
        """Raise PlanError if the minimum radius makes the shortest path unreasonably long."""
        min_radius = self.costs.least_radius(self.speed)
        if self.reverse or self.on_the_spot or min_radius == 0.0:
            return
        stops = np.concatenate([self.start[None, :2], self.via, self.goal[None, :2]])
        direct = float(np.hypot(*np.diff(stops, axis=0).T).sum())
        shortest = paths.get("distance") if self.free is None else self._search("distance", None).run()
        if shortest is not None and shortest.cost > self.settings.motion.longest_detour * direct:
            raise PlanError(
                f"goal {pose_text(self.goal)}: it needs turns below the minimum radius of {min_radius:.2f} m at "
                f"{self.speed:g} m/s; the shortest path with it has {shortest.cost:.1f} m for {direct:.2f} m of "
                f"distance; {self._remedies()}"
            )

    def _optimise(self, minimise: Objective, path: PlanSearchResult) -> Plan:
        """Optimise, sample and check a path; after a failure, stop between the pieces of the search."""
        spot = spot_rate(self.costs, self.settings.motion.yaw_rate) if self.on_the_spot else 0.0
        last = np.array([*self.goal[:2], self._unwrapped_goal_heading(path)])
        schedule = build_schedule(self.costs, self.start, path.pieces, self.sharpest, spot, self.settings)
        polished = polish(self.costs, minimise, schedule, self.start, last, self.via, self.settings, self.clearance)
        commands = self._commands(schedule, polished.durations, polished.yaw_rates, last)
        fault = self._find_fault(commands, last)
        if fault is None:
            status = POLISHED if polished.solved else UNFINISHED
            return self._plan(minimise, commands, path, status, polished.status)
        reason = f"{polished.status}; {fault}"
        stop_schedule = build_schedule(
            self.costs, self.start, path.pieces, self.sharpest, spot, self.settings, stop_at_corners=True
        )
        commands = self._commands(stop_schedule, stop_schedule.durations, stop_schedule.yaw_rates, last)
        fault = self._find_fault(commands, last)
        if fault is not None:
            raise PlanError(
                f"goal {pose_text(self.goal)}: a path was found, but no valid reference (optimised: {reason}; "
                f"unchanged: {fault}); give more room or another goal"
            )
        return self._plan(minimise, commands, path, SEARCHED, reason)

    def _commands(self, schedule: Schedule, durations: FloatArray, rates: FloatArray, last: FloatArray) -> FloatArray:
        yaw_rates, phase_durations = match_goal(
            self.costs, schedule, durations, rates, self.start, last, self.sample_time
        )
        return sample_commands(schedule, phase_durations, yaw_rates, self.sample_time)

    def _find_fault(self, commands: FloatArray, last: FloatArray) -> str | None:
        """Integrate the commands and return the first violated condition; None if all hold."""
        motion = self.settings.motion
        poses = integrate_commands(self.costs, commands, self.start, self.sample_time)
        error = float(np.abs(poses[-1] - last).max())
        if not error < _END_TOLERANCE:
            return f"it ends {error:.2g} m or rad from the goal"
        v, omega = np.abs(commands.T)
        if v.max() > self.speed * (1 + _EXCESS):
            return f"it drives {v.max():.3g} m/s"
        if omega.max() > motion.yaw_rate * (1 + _EXCESS):
            return f"it turns {omega.max():.3g} rad/s"
        # On ramps the means over samples do not give the radius.
        turning = (v > 0.1 * self.speed) & (omega > 1e-6)
        radius = float((v[turning] / omega[turning]).min()) if turning.any() else math.inf
        if radius < self.costs.least_radius(self.speed) and not self.on_the_spot:
            return f"it turns at {radius:.3g} m"
        for i, point in enumerate(self.via):
            distance = float(np.hypot(*(poses[:, :2] - point).T).min())
            if distance > _VIA_TOLERANCE:
                return f"it passes via {i + 1} at {distance:.2f} m"
        if self.clearance is not None:
            room = float(self.clearance.of_poses(poses).min())
            if room < motion.margin - 1e-3:
                return f"it comes as near as {room:.3f} m to an obstacle"
        return None

    def _plan(
        self, minimise: Objective, commands: FloatArray, paths: PlanSearchResult, status: str, solver: str
    ) -> Plan:
        dt = self.sample_time
        poses, power = integrate_commands(self.costs, commands, self.start, dt), self.costs.power(commands)
        twists = self.costs.twist(commands)
        rows = np.column_stack([dt * np.arange(len(poses)), poses])
        # The limits are wide, because `_find_fault` has checked them.
        limits = TrajectoryLimits(10.0, 100.0, 100.0, 1000.0)
        try:
            trajectory = fit_timed_poses(rows, limits, name=f"plan-{minimise}", where="plan")
        except ConfigError as error:
            raise PlanError(
                f"goal {pose_text(self.goal)}: at {self.speed:g} m/s the robot slips laterally at "
                f"{_max_lateral_speed(twists):.3f} m/s in turns, too much for a reference; lower the speed"
            ) from error
        return Plan(
            minimise=minimise,
            trajectory=trajectory,
            poses=poses,
            commands=commands,
            power=power,
            sample_time=dt,
            energy=float(power.sum() * dt),
            duration=dt * len(commands),
            length=float(np.hypot(twists[:, 0], twists[:, 1]).sum() * dt),
            pieces=paths.pieces,
            sharpest=self.sharpest,
            clearance=math.inf if self.clearance is None else float(self.clearance.of_poses(poses).min()),
            search=paths,
            status=status,
            solver=solver,
        )

    def _unwrapped_goal_heading(self, path: PlanSearchResult) -> float:
        """Return the heading of the goal with the full turns of the search [rad]."""
        rotation = sum(piece.duration * float(self.costs.twist([piece.v, piece.omega])[2]) for piece in path.pieces)
        full_turns = round((float(self.start[2]) + rotation - float(self.goal[2])) / (2 * math.pi))
        return float(self.goal[2]) + 2 * math.pi * full_turns

    def _remedies(self) -> str:
        back = "" if self.reverse else "allow driving backward (--reverse) or turning on the spot (--on-the-spot), "
        return f"{back}give the goal another heading or more room, or lower the speed"


def _max_lateral_speed(twists: FloatArray) -> float:
    return float(np.abs(twists[:, 1]).max())
