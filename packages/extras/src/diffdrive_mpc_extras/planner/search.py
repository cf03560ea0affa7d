"""Sampling-based A* over inputs, which finds the shape of the path.

Source: SBMPO (Sampling-Based Model Predictive Optimization), section 4.3 of Ordonez et al., 2017 (P4). A graph grows by
sampled inputs through the slip-calibrated kinematics; the state with the minimum sum of its cost and a lower bound of
the remaining cost is expanded first. Extensions: only the cheapest state of each grid cell is kept, and closed-form
paths (`Words`) connect each state to the goal, so that the end is exact and the best known path bounds the search.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc_extras.planner.clearance import ClearanceMap
from diffdrive_mpc_extras.planner.inputs import (
    Index,
    Inputs,
    Mask,
    Words,
    arc_arc_arc,
    arc_straight,
    arc_straight_arc,
    move_poses,
)
from diffdrive_mpc_extras.planner.settings import SearchSettings

# Distance and angle between two poses that are checked against the map [m, rad].
_CHECK, _CHECK_ANGLE = 0.12, 0.3
# Distance from a target below which its direction implies no turn [m].
_NEAR = 0.3
# Maximum number of paths of a batch that are checked against the map, cheapest first.
_MAX_CHECKED = 120


class Piece(NamedTuple):
    """Input that is held for a time."""

    v: float
    """Commanded speed [m/s]."""
    omega: float
    """Commanded yaw rate [rad/s]."""
    duration: float
    """Duration [s]."""
    leg: int
    """Index of the leg; each via point ends a leg."""

    @property
    def radius(self) -> float:
        """Commanded radius [m], positive to the left; infinity for straight motion."""
        return self.v / self.omega if abs(self.omega) > 1e-9 else np.inf


class PlanSearchResult(NamedTuple):
    """Result of the search."""

    pieces: tuple[Piece, ...]
    cost: float
    """Objective, without acceleration and braking."""
    bound: float
    """Lower bound of the cost of all sequences of the sampled inputs."""
    states: int
    """Number of expanded states."""
    complete: bool
    """True if the cost is within the gap of the lower bound."""


InputSequence = tuple[tuple[int, float], ...]
"""Sequence of inputs by index, with the duration of each [s]."""


class _Tree:
    """Search tree of states; only the cheapest state of each grid cell is kept."""

    def __init__(self, start: FloatArray, estimate: float, settings: SearchSettings) -> None:
        self.poses, self.costs, self.legs = [start], [0.0], [0]
        self._estimates = [estimate]
        # Greedy until a path is known, then best-first.
        self._eager = settings.eager
        self._heap = [(estimate, 0)]
        self._settings = settings
        self._parents: list[tuple[int, InputSequence]] = [(-1, ())]
        self._best: dict[tuple[int, ...], float] = {}
        self._expanded: set[tuple[int, ...]] = set()
        self._ending: tuple[int, InputSequence] | None = None
        self.min_cost = math.inf
        """Minimum cost of the known paths to the goal."""

    @property
    def prune_cost(self) -> float:
        """Estimate from which a state is pruned."""
        return self.min_cost * (1 - self._settings.gap)

    @property
    def open_bound(self) -> float:
        """Lower bound of the cost of open states."""
        return min((self._estimates[node] for _, node in self._heap), default=self.min_cost)

    def add(self, parent: int, held: InputSequence, pose: FloatArray, leg: int, cost: float, left: float) -> None:
        """Add a state unless it is pruned."""
        if cost + left >= self.prune_cost:
            return
        key = self._key(pose, leg)
        if cost >= self._best.get(key, math.inf):
            return
        self._best[key] = cost
        self.poses.append(pose)
        self.costs.append(cost)
        self.legs.append(leg)
        self._parents.append((parent, held))
        self._estimates.append(cost + left)
        heapq.heappush(self._heap, (cost + self._eager * left, len(self.poses) - 1))

    def arrive(self, parent: int, held: InputSequence, cost: float) -> None:
        """Register a path to the goal."""
        if cost < self.min_cost:
            self.min_cost, self._ending = cost, (parent, held)
            if self._eager > 1.0:
                self._eager = 1.0
                self._heap = [(self._estimates[node], node) for _, node in self._heap]
                heapq.heapify(self._heap)
                # A state that was expanded early may be reached at a lower cost later.
                self._expanded.clear()

    def batch(self, max_count: int) -> list[int]:
        """Return the cheapest open states."""
        nodes: list[int] = []
        while self._heap and len(nodes) < max_count and self._heap[0][0] < self.prune_cost:
            _, node = heapq.heappop(self._heap)
            key = self._key(self.poses[node], self.legs[node])
            if key not in self._expanded or node == 0:
                self._expanded.add(key)
                nodes.append(node)
        return nodes

    def path(self) -> list[tuple[InputSequence, int]] | None:
        """Return the inputs from start to goal with their legs; None if no path is known."""
        if self._ending is None:
            return None
        node, held = self._ending
        parts = [(held, self.legs[node])]
        while node > 0:
            before, held = self._parents[node]
            parts.append((held, self.legs[before]))
            node = before
        return parts[::-1]

    def _key(self, pose: FloatArray, leg: int) -> tuple[int, ...]:
        search_settings, (x, y, theta) = self._settings, pose.tolist()
        heading = round(theta / (2 * math.pi) * search_settings.headings) % search_settings.headings
        return leg, round(x / search_settings.cell), round(y / search_settings.cell), heading


class PlanSearch:
    """Search of one shape.

    Parameters
    ----------
    inputs
        Inputs of the search.
    start, goal
        (3,) poses.
    via
        (n, 2) via points in order.
    settings
        Settings of the search.
    free
        Map of clearances and margin [m]; None for no obstacles.
    """

    def __init__(
        self,
        inputs: Inputs,
        start: FloatArray,
        goal: FloatArray,
        via: FloatArray,
        settings: SearchSettings,
        free: tuple[ClearanceMap, float] | None,
    ) -> None:
        self._inputs, self._settings, self._free = inputs, settings, free
        self._goal, self._via = goal, via
        self._start = start
        self._targets = np.concatenate([via, goal[None, :2]])
        self._fields = None if free is None else [free[0].distances(target, free[1]) for target in self._targets]
        self._prices = inputs.multipliers()
        omega = np.abs(inputs.twists[:, 2])
        slow = np.maximum(inputs.speeds / settings.step, omega / settings.step_angle)
        self._times = 1.0 / slow
        self._all_inputs = np.arange(len(inputs.commands))
        self._displacements = inputs.displacements(self._all_inputs, self._times)
        parts = max(2, int(np.ceil(max(settings.step / _CHECK, settings.step_angle / _CHECK_ANGLE))))
        share = np.arange(1, parts + 1) / parts
        self._intermediate = inputs.displacements(self._all_inputs[:, None], self._times[:, None] * share)
        self._connection_rows = self._select_few()
        self._connection_inputs = inputs.select(self._connection_rows)
        # A body with side slip does not move along its heading.
        moving = inputs.twists[inputs.speeds > 1e-9]
        drift = np.arctan2(moving[:, 1], np.abs(moving[:, 0]))
        self._drift = float(np.abs(drift).max())
        self._both_ways = bool((inputs.commands[:, 0] < 0).any())

    def reachable(self) -> bool:
        """Return True if the goal is reachable without turning constraints."""
        if self._fields is None:
            return True
        points = np.concatenate([self._start[None, :2], self._via])
        return all(bool(np.isfinite(field(point[None]))[0]) for field, point in zip(self._fields, points, strict=True))

    def bound_from(self, pose: FloatArray) -> float:
        """Compute a lower bound of the cost from a pose (3,) on the first leg."""
        return float(self._remaining_bound(pose[None], 0)[0])

    def run(self) -> PlanSearchResult | None:
        """Run the search; return None if no path is found."""
        search_settings, count = self._settings, 0
        tree = _Tree(self._start, self.bound_from(self._start), search_settings)
        while count < search_settings.most_states:
            batch = tree.batch(search_settings.batch if count else 1)
            if not batch:
                break
            for leg in sorted({tree.legs[node] for node in batch}):
                nodes = [node for node in batch if tree.legs[node] == leg]
                self._connect(tree, nodes, leg, is_root=count == 0)
                self._expand(tree, nodes, leg)
            count += len(batch)
        path = tree.path()
        if path is None:
            return None
        complete = tree.open_bound >= tree.prune_cost
        return PlanSearchResult(self._pieces(path), tree.min_cost, min(tree.min_cost, tree.open_bound), count, complete)

    def _connect(self, tree: _Tree, nodes: list[int], leg: int, *, is_root: bool) -> None:
        """Connect states to the end of the leg in closed form; a reached via point becomes a state of the next leg."""
        poses, costs = np.array([tree.poses[node] for node in nodes]), np.array([tree.costs[node] for node in nodes])
        words = self._words(poses, leg, is_root=is_root)
        total = costs[words.start] + words.costs
        last = leg == len(self._via)
        for row in self._cheapest(words, total, poses, tree.min_cost, 1 if last else 4 * len(nodes)):
            held, node, cost = self._input_sequence(words, row), nodes[words.start[row]], float(total[row])
            if last:
                tree.arrive(node, held, cost)
                continue
            pose = self._end(poses[words.start[row]], held)
            pose[:2] = self._via[leg]
            tree.add(node, held, pose, leg + 1, cost, float(self._remaining_bound(pose[None], leg + 1)[0]))

    def _expand(self, tree: _Tree, nodes: list[int], leg: int) -> None:
        """Expand states by one step of each input."""
        poses, costs = np.array([tree.poses[node] for node in nodes]), np.array([tree.costs[node] for node in nodes])
        after = move_poses(poses[:, None], self._displacements[None])
        reached = costs[:, None] + self._inputs.rates * self._times
        left = self._remaining_bound(after.reshape(-1, 3), leg).reshape(reached.shape)
        rows, used = np.nonzero(reached + left < tree.prune_cost)
        if self._free is not None and len(rows):
            path = move_poses(poses[rows, None], self._intermediate[used])
            clear = self._free[0].free(path, self._free[1]).all(axis=1)
            rows, used = rows[clear], used[clear]
        for row, input_number in zip(rows.tolist(), used.tolist(), strict=True):
            held = ((input_number, float(self._times[input_number])),)
            tree.add(
                nodes[row],
                held,
                after[row, input_number],
                leg,
                float(reached[row, input_number]),
                float(left[row, input_number]),
            )

    def _words(self, poses: FloatArray, leg: int, *, is_root: bool) -> Words:
        """Generate paths to the end of the leg: all inputs and three arcs from the start, few inputs elsewhere."""
        if leg < len(self._via):
            return arc_straight(self._inputs, poses, self._via[leg])
        if is_root:
            every = [arc_straight_arc(self._inputs, poses, self._goal), self._connect_few(arc_arc_arc, poses)]
            return Words(*(np.concatenate(parts) for parts in zip(*every, strict=True)))
        return self._connect_few(arc_straight_arc, poses)

    def _connect_few(self, kind: Callable[[Inputs, FloatArray, FloatArray], Words], poses: FloatArray) -> Words:
        """Generate paths of few inputs, with their indices among all inputs."""
        words = kind(self._connection_inputs, poses, self._goal)
        return words._replace(inputs=self._connection_rows[words.inputs])

    def _select_few(self) -> Index:
        """Select a few inputs from wide to sharp, and all straight inputs and turns on the spot."""
        inputs = self._inputs
        special = inputs.straight | (inputs.commands[:, 0] == 0)
        turning = np.flatnonzero(~special)
        curvature = np.abs(inputs.commands[turning, 1] / inputs.commands[turning, 0])
        order = turning[np.argsort(curvature, kind="stable")]
        sides = order.reshape(-1, 4 if (inputs.commands[:, 0] < 0).any() else 2)
        picks = np.unique(np.rint(np.linspace(0, len(sides) - 1, self._settings.shots)).astype(int))
        return np.sort(np.concatenate([np.flatnonzero(special), sides[picks].ravel()]))

    def _remaining_bound(self, poses: FloatArray, leg: int) -> FloatArray:
        """Compute a lower bound (n,) of the remaining cost from poses (n, 3) on a leg."""
        targets = self._targets[leg:]
        gap = targets[0] - poses[:, :2]
        far = np.hypot(*gap.T)
        if self._fields is not None:
            far = np.maximum(far, self._fields[leg](poses[:, :2]))
        rest = float(np.hypot(*np.diff(targets, axis=0).T).sum())
        bearing = np.arctan2(gap[:, 1], gap[:, 0])
        # At some point the direction of travel is that of the chord.
        turn = np.maximum(self._angle(bearing - poses[:, 2]) - self._drift, 0.0)
        if leg == len(self._via):
            turn = turn + np.maximum(self._angle(self._goal[2] - bearing) - self._drift, 0.0)
            min_turn = np.abs(wrap_angle(self._goal[2] - poses[:, 2]))
            turn = np.where(far > _NEAR, np.maximum(turn, min_turn), min_turn)
        else:
            turn = np.where(far > _NEAR, turn, 0.0)
        metre, radian = self._prices
        with np.errstate(invalid="ignore"):
            bounds = (far + rest)[:, None] * metre[1:] + turn[:, None] * radian[1:]
        flat = turn * radian[0]
        return np.asarray(np.maximum(bounds.max(axis=1), flat))

    def _angle(self, angle: FloatArray) -> FloatArray:
        """Return the necessary turn [rad]; it is smaller if the robot may reverse."""
        magnitude = np.abs(wrap_angle(angle))
        return np.minimum(magnitude, np.pi - magnitude) if self._both_ways else magnitude

    def _cheapest(
        self, words: Words, total: FloatArray, poses: FloatArray, max_cost: float, max_count: int
    ) -> list[int]:
        """Select up to `max_count` of the cheapest free paths below `max_cost`."""
        rows = np.flatnonzero(total < max_cost)
        rows = rows[np.argsort(total[rows], kind="stable")]
        if self._free is None:
            return [int(row) for row in rows[:max_count]]
        rows = rows[:_MAX_CHECKED]
        clear = self._are_free(self._free, poses[words.start[rows]], words.inputs[rows], words.times[rows])
        return [int(row) for row in rows[clear][:max_count]]

    def _are_free(self, free: tuple[ClearanceMap, float], poses: FloatArray, held: Index, times: FloatArray) -> Mask:
        """Return (k,) True for paths of three pieces (k, 3) from poses (k, 3) with enough clearance."""
        clear, ends = np.ones(len(held), dtype=bool), poses
        for piece in range(held.shape[1]):
            inputs, durations = held[:, piece], times[:, piece]
            speed, omega = self._inputs.speeds[inputs], np.abs(self._inputs.twists[inputs, 2])
            parts = float((durations * np.maximum(speed / _CHECK, omega / _CHECK_ANGLE)).max(initial=0.0))
            share = np.linspace(0.0, 1.0, max(2, math.ceil(parts) + 1))
            path = move_poses(ends[:, None], self._inputs.displacements(inputs[:, None], durations[:, None] * share))
            clear &= free[0].free(path, free[1]).all(axis=1)
            ends = path[:, -1]
        return clear

    def _input_sequence(self, words: Words, row: int) -> InputSequence:
        pairs = zip(words.inputs[row].tolist(), words.times[row].tolist(), strict=True)
        return tuple((input_number, time) for input_number, time in pairs if time > 0)

    def _end(self, pose: FloatArray, held: InputSequence) -> FloatArray:
        for input_number, time in held:
            pose = move_poses(pose, self._inputs.displacements(np.array(input_number), np.array(time)))
        return pose

    def _pieces(self, path: list[tuple[InputSequence, int]]) -> tuple[Piece, ...]:
        """Convert a path to pieces, and merge consecutive pieces of equal inputs."""
        pieces: list[Piece] = []
        for held, leg in path:
            for input_number, time in held:
                v, omega = self._inputs.commands[input_number].tolist()
                if pieces and pieces[-1][:2] == (v, omega) and pieces[-1].leg == leg:
                    pieces[-1] = pieces[-1]._replace(duration=pieces[-1].duration + time)
                else:
                    pieces.append(Piece(v, omega, time, leg))
        return tuple(pieces)
