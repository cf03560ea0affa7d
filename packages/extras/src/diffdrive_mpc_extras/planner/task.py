"""One task: shapes by search, each polished, proven by forward integration, and the best of them."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.timed_poses import lay_timed_poses
from diffdrive_mpc_extras.planner.clearance import Clearance, ClearanceMap, PlanError, words_of
from diffdrive_mpc_extras.planner.inputs import OBJECTIVES, Objective, make_inputs, spot_rate
from diffdrive_mpc_extras.planner.polish import polish
from diffdrive_mpc_extras.planner.result import POLISHED, SEARCHED, UNFINISHED, Plan, driven, made_exact, sampled
from diffdrive_mpc_extras.planner.schedule import Schedule, laid_out
from diffdrive_mpc_extras.planner.search import PlanSearch, PlanSearchResult
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts

# Tolerances of a plan for its end [m, rad], the limits (ratio), and the via points [m].
_END_TOLERANCE, _EXCESS, _BESIDE = 1e-4, 5e-3, 0.02
_EQUAL = 1e-4


@dataclass(frozen=True, eq=False)
class Task:
    """From where to where, how, on which floor.

    Attributes
    ----------
    costs
        The robot on its floor.
    start, goal
        (3,) poses.
    via
        (n, 2) points.
    speed
        [m/s].
    sharpest
        Least commanded radius [m].
    clearance, free
        Exact distances to the obstacles, and their map for the search; None without obstacles.
    reverse, on_the_spot
        Whether the robot may drive backward and turn on the spot.
    sample_time
        [s].
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
        """Search the best shape for each objective; raise PlanError if there is none."""
        paths: dict[Objective, PlanSearchResult] = {}
        for objective in OBJECTIVES:
            search = self._search(objective, self.free)
            if not paths and not search.reachable():
                wide = 2 * float(self.clearance.robot[0, 2]) if self.clearance is not None else 0.0
                raise PlanError(
                    f"goal {words_of(self.goal)}: obstacles leave no way for a robot {wide:.2f} m wide with "
                    f"{self.settings.motion.margin:g} m on each side; take a smaller margin or another goal"
                )
            shape = search.run()
            if shape is not None:
                paths[objective] = shape
        if not paths:
            raise PlanError(
                f"goal {words_of(self.goal)}: no way was found in {self.settings.search.most_states:,} states with "
                f"turns no sharper than {self.sharpest:.2f} m; {self._remedies()}"
            )
        self._check_detour(paths)
        return paths

    def candidates(self, shapes: dict[Objective, PlanSearchResult]) -> list[Plan]:
        """Optimise each shape for its objective; raise PlanError if none of them can be driven."""
        made, faults = [], []
        for objective, shape in shapes.items():
            try:
                made.append(self._polished(objective, shape))
            except PlanError as error:
                faults.append(error)
        if not made:
            raise faults[0]
        return made

    def best(self, minimise: Objective, shapes: dict[Objective, PlanSearchResult], made: list[Plan]) -> Plan:
        """Select the best candidate; if it has another shape, polish that for `minimise` and use the better one."""
        least = min(candidate.amount(minimise) for candidate in made)
        # Of equals that which was polished for it.
        equal = [candidate for candidate in made if candidate.amount(minimise) <= least * (1 + _EQUAL)]
        best = next((candidate for candidate in equal if candidate.minimise == minimise), equal[0])
        if best.minimise != minimise:
            with suppress(PlanError):
                best = min(best, self._polished(minimise, shapes[best.minimise]), key=lambda row: row.amount(minimise))
        return best.for_objective(minimise, shapes.get(minimise, best.search))

    def _search(self, objective: Objective, free: tuple[ClearanceMap, float] | None) -> PlanSearch:
        inputs = make_inputs(
            self.costs, objective, self.speed, self.settings, reverse=self.reverse, spot=self.on_the_spot
        )
        return PlanSearch(inputs, self.start, self.goal, self.via, self.settings.search, free)

    def _check_detour(self, paths: dict[Objective, PlanSearchResult]) -> None:
        """Refuse a goal that only sharper turns reach in a sensible way."""
        least = self.costs.least_radius(self.speed)
        if self.reverse or self.on_the_spot or least == 0.0:
            return
        stops = np.concatenate([self.start[None, :2], self.via, self.goal[None, :2]])
        direct = float(np.hypot(*np.diff(stops, axis=0).T).sum())
        shortest = paths.get("distance") if self.free is None else self._search("distance", None).run()
        if shortest is not None and shortest.cost > self.settings.motion.longest_detour * direct:
            raise PlanError(
                f"goal {words_of(self.goal)}: it takes turns sharper than the least radius of {least:.2f} m at "
                f"{self.speed:g} m/s; the shortest way within it is {shortest.cost:.1f} m for {direct:.2f} m of "
                f"distance; {self._remedies()}"
            )

    def _polished(self, minimise: Objective, path: PlanSearchResult) -> Plan:
        """Optimise, sample and check; after a failure, use the search's path with a stop between any two pieces."""
        spot = spot_rate(self.costs, self.settings.motion.yaw_rate) if self.on_the_spot else 0.0
        last = np.array([*self.goal[:2], self._unwrapped(path)])
        schedule = laid_out(self.costs, self.start, path.pieces, self.sharpest, spot, self.settings)
        polished = polish(self.costs, minimise, schedule, self.start, last, self.via, self.settings, self.clearance)
        commands = self._made(schedule, polished.durations, polished.yaw_rates, last)
        fault = self._fault(commands, last)
        if fault is None:
            status = POLISHED if polished.solved else UNFINISHED
            return self._plan(minimise, commands, path, status, polished.status)
        words = f"{polished.status}; {fault}"
        stopping = laid_out(
            self.costs, self.start, path.pieces, self.sharpest, spot, self.settings, stop_at_corners=True
        )
        commands = self._made(stopping, stopping.durations, stopping.yaw_rates, last)
        fault = self._fault(commands, last)
        if fault is not None:
            raise PlanError(
                f"goal {words_of(self.goal)}: a way was found, but no reference that keeps to it (polish: {words}; as "
                f"searched: {fault}); give more room or another goal"
            )
        return self._plan(minimise, commands, path, SEARCHED, words)

    def _made(self, schedule: Schedule, durations: FloatArray, rates: FloatArray, last: FloatArray) -> FloatArray:
        exact, lasting = made_exact(self.costs, schedule, durations, rates, self.start, last, self.sample_time)
        return sampled(schedule, lasting, exact, self.sample_time)

    def _fault(self, commands: FloatArray, last: FloatArray) -> str | None:
        """Describe a fault of commands by forward integration; None without one."""
        motion = self.settings.motion
        poses = driven(self.costs, commands, self.start, self.sample_time)
        off = float(np.abs(poses[-1] - last).max())
        if not off < _END_TOLERANCE:
            return f"it ends {off:.2g} m or rad beside the goal"
        v, omega = np.abs(commands.T)
        if v.max() > self.speed * (1 + _EXCESS):
            return f"it drives {v.max():.3g} m/s"
        if omega.max() > motion.yaw_rate * (1 + _EXCESS):
            return f"it turns {omega.max():.3g} rad/s"
        # Slower than a tenth of the speed it is on a ramp, whose means over samples say little of the radius.
        turning = (v > 0.1 * self.speed) & (omega > 1e-6)
        radius = float((v[turning] / omega[turning]).min()) if turning.any() else math.inf
        if radius < self.costs.least_radius(self.speed) and not self.on_the_spot:
            return f"it turns at {radius:.3g} m"
        for i, point in enumerate(self.via):
            beside = float(np.hypot(*(poses[:, :2] - point).T).min())
            if beside > _BESIDE:
                return f"it passes via {i + 1} at {beside:.2f} m"
        if self.clearance is not None:
            room = float(self.clearance.of_poses(poses).min())
            if room < motion.margin - 1e-3:
                return f"it comes as near as {room:.3f} m to an obstacle"
        return None

    def _plan(
        self, minimise: Objective, commands: FloatArray, paths: PlanSearchResult, status: str, solver: str
    ) -> Plan:
        dt = self.sample_time
        poses, power = driven(self.costs, commands, self.start, dt), self.costs.power(commands)
        twists = self.costs.twist(commands)
        rows = np.column_stack([dt * np.arange(len(poses)), poses])
        # This checks that the rows are a path; limits were checked above.
        limits = TrajectoryLimits(10.0, 100.0, 100.0, 1000.0)
        try:
            trajectory = lay_timed_poses(rows, limits, name=f"plan-{minimise}", where="plan")
        except ConfigError as error:
            raise PlanError(
                f"goal {words_of(self.goal)}: at {self.speed:g} m/s the robot slides sideways "
                f"{_most_lateral(twists):.3f} m/s in turns of the plan, more than a reference may; go slower"
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

    def _unwrapped(self, path: PlanSearchResult) -> float:
        """Return the heading of the goal with the whole turns of the search [rad]."""
        turned = sum(piece.duration * float(self.costs.twist([piece.v, piece.omega])[2]) for piece in path.pieces)
        whole = round((float(self.start[2]) + turned - float(self.goal[2])) / (2 * math.pi))
        return float(self.goal[2]) + 2 * math.pi * whole

    def _remedies(self) -> str:
        back = "" if self.reverse else "allow driving backward (--reverse) or turning on the spot (--on-the-spot), "
        return f"{back}give the goal another heading or more room, or go slower"


def _most_lateral(twists: FloatArray) -> float:
    return float(np.abs(twists[:, 1]).max())
