"""Sampling-based A* over inputs: the shape of the way.

After SBMPO (Sampling-Based Model Predictive Optimization), with which Ordonez et al., 2017 (P4), section 4.3, plan: a
graph grows by sampled inputs through the slip-calibrated kinematics, the state with the least sum of its cost and a
lower bound of the remaining cost first. Added here: of states in one cell of the grid the cheapest is kept; from every
state the goal is tried in closed form (`words`), so that the end is exact and the best way known bounds the search at
any time.
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
    placed,
)
from diffdrive_mpc_extras.planner.settings import SearchSettings

# Between two poses that are held against the map [m, rad].
_CHECK, _CHECK_ANGLE = 0.12, 0.3
# Within this distance of a target its direction does not determine a necessary turn [m].
_NEAR = 0.3
# Number of ways from a batch that are checked against the map, cheapest first.
_TRIED = 120


class Piece(NamedTuple):
    """An input that is held."""

    v: float
    """commanded [m/s]"""
    omega: float
    """commanded [rad/s]"""
    duration: float
    """[s]"""
    leg: int
    """0 until the first via point, 1 until the second, ..."""

    @property
    def radius(self) -> float:
        """Commanded [m], positive to the left; infinite straight on."""
        return self.v / self.omega if abs(self.omega) > 1e-9 else np.inf


class PlanSearchResult(NamedTuple):
    """Result of the search."""

    pieces: tuple[Piece, ...]
    cost: float
    """Value of the objective, without acceleration and braking."""
    bound: float
    """no sequence of the sampled inputs is cheaper"""
    states: int
    """that were taken up"""
    complete: bool
    """True if the search ended because nothing can be better by more than the gap."""


Held = tuple[tuple[int, float], ...]
"""Numbers of inputs and how long each is held [s]."""


class _Tree:
    """States and how each was reached; of those in one cell of the grid the cheapest is kept."""

    def __init__(self, start: FloatArray, estimate: float, settings: SearchSettings) -> None:
        self.poses, self.costs, self.legs = [start], [0.0], [0]
        self._estimates = [estimate]
        # Greedy until a way is known, then the best first.
        self._eager = settings.eager
        self._heap = [(estimate, 0)]
        self._settings = settings
        self._parents: list[tuple[int, Held]] = [(-1, ())]
        self._best: dict[tuple[int, ...], float] = {}
        self._taken: set[tuple[int, ...]] = set()
        self._ending: tuple[int, Held] | None = None
        self.least = math.inf
        """of the ways to the goal"""

    @property
    def enough(self) -> float:
        """Estimate from which a state is not worth adding."""
        return self.least * (1 - self._settings.gap)

    @property
    def open_bound(self) -> float:
        """Return the lower bound of the cost of open states."""
        return min((self._estimates[node] for _, node in self._heap), default=self.least)

    def add(self, parent: int, held: Held, pose: FloatArray, leg: int, cost: float, left: float) -> None:
        """Add a state if it is worth it."""
        if cost + left >= self.enough:
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

    def arrive(self, parent: int, held: Held, cost: float) -> None:
        """Add a path to the goal."""
        if cost < self.least:
            self.least, self._ending = cost, (parent, held)
            if self._eager > 1.0:
                self._eager = 1.0
                self._heap = [(self._estimates[node], node) for _, node in self._heap]
                heapq.heapify(self._heap)
                # A state that was expanded early may be reached at less cost.
                self._taken.clear()

    def batch(self, most: int) -> list[int]:
        """Return the cheapest open states."""
        nodes: list[int] = []
        while self._heap and len(nodes) < most and self._heap[0][0] < self.enough:
            _, node = heapq.heappop(self._heap)
            key = self._key(self.poses[node], self.legs[node])
            if key not in self._taken or node == 0:
                self._taken.add(key)
                nodes.append(node)
        return nodes

    def way(self) -> list[tuple[Held, int]] | None:
        """Return the inputs from start to goal with their legs; None without a known path."""
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
    """One task.

    Parameters
    ----------
    inputs
        To sample.
    start, goal
        (3,) poses.
    via
        (n, 2) points to pass in this order.
    settings
        Settings of the search.
    free
        Map of clearances and the margin [m]; None without obstacles.
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
        self._every = np.arange(len(inputs.commands))
        self._moved = inputs.moved(self._every, self._times)
        parts = max(2, int(np.ceil(max(settings.step / _CHECK, settings.step_angle / _CHECK_ANGLE))))
        share = np.arange(1, parts + 1) / parts
        self._inside = inputs.moved(self._every[:, None], self._times[:, None] * share)
        self._shot_rows = self._few()
        self._shots = inputs.chosen(self._shot_rows)
        # A body that drifts sideways does not move along its heading.
        moving = inputs.twists[inputs.speeds > 1e-9]
        drift = np.arctan2(moving[:, 1], np.abs(moving[:, 0]))
        self._drift = float(np.abs(drift).max())
        self._both_ways = bool((inputs.commands[:, 0] < 0).any())

    def reachable(self) -> bool:
        """Return True if a point can reach the goal, without regard to turns."""
        if self._fields is None:
            return True
        points = np.concatenate([self._start[None, :2], self._via])
        return all(bool(np.isfinite(field(point[None]))[0]) for field, point in zip(self._fields, points, strict=True))

    def bound_from(self, pose: FloatArray) -> float:
        """Compute a lower bound of the cost from a pose (3,) on the first leg."""
        return float(self._left(pose[None], 0)[0])

    def run(self) -> PlanSearchResult | None:
        """Search; None where no way was found."""
        search_settings, count = self._settings, 0
        tree = _Tree(self._start, self.bound_from(self._start), search_settings)
        while count < search_settings.most_states:
            batch = tree.batch(search_settings.batch if count else 1)
            if not batch:
                break
            for leg in sorted({tree.legs[node] for node in batch}):
                nodes = [node for node in batch if tree.legs[node] == leg]
                self._shoot(tree, nodes, leg, whole=count == 0)
                self._expand(tree, nodes, leg)
            count += len(batch)
        way = tree.way()
        if way is None:
            return None
        complete = tree.open_bound >= tree.enough
        return PlanSearchResult(self._pieces(way), tree.least, min(tree.least, tree.open_bound), count, complete)

    def _shoot(self, tree: _Tree, nodes: list[int], leg: int, *, whole: bool) -> None:
        """Try the end of the leg from some states; a via point that is reached is a state of the next leg."""
        poses, costs = np.array([tree.poses[node] for node in nodes]), np.array([tree.costs[node] for node in nodes])
        words = self._words(poses, leg, whole=whole)
        total = costs[words.start] + words.costs
        last = leg == len(self._via)
        for row in self._cheapest(words, total, poses, tree.least, 1 if last else 4 * len(nodes)):
            held, node, cost = self._held(words, row), nodes[words.start[row]], float(total[row])
            if last:
                tree.arrive(node, held, cost)
                continue
            pose = self._end(poses[words.start[row]], held)
            pose[:2] = self._via[leg]
            tree.add(node, held, pose, leg + 1, cost, float(self._left(pose[None], leg + 1)[0]))

    def _expand(self, tree: _Tree, nodes: list[int], leg: int) -> None:
        """Hold every input for a step."""
        poses, costs = np.array([tree.poses[node] for node in nodes]), np.array([tree.costs[node] for node in nodes])
        after = placed(poses[:, None], self._moved[None])
        reached = costs[:, None] + self._inputs.rates * self._times
        left = self._left(after.reshape(-1, 3), leg).reshape(reached.shape)
        rows, used = np.nonzero(reached + left < tree.enough)
        if self._free is not None and len(rows):
            way = placed(poses[rows, None], self._inside[used])
            clear = self._free[0].free(way, self._free[1]).all(axis=1)
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

    def _words(self, poses: FloatArray, leg: int, *, whole: bool) -> Words:
        """Generate paths to the end of the leg: of every input and three arcs from the start, of few elsewhere."""
        if leg < len(self._via):
            return arc_straight(self._inputs, poses, self._via[leg])
        if whole:
            every = [arc_straight_arc(self._inputs, poses, self._goal), self._of_few(arc_arc_arc, poses)]
            return Words(*(np.concatenate(parts) for parts in zip(*every, strict=True)))
        return self._of_few(arc_straight_arc, poses)

    def _of_few(self, kind: Callable[[Inputs, FloatArray, FloatArray], Words], poses: FloatArray) -> Words:
        """Generate paths of few inputs, with their numbers among all inputs."""
        words = kind(self._shots, poses, self._goal)
        return words._replace(inputs=self._shot_rows[words.inputs])

    def _few(self) -> Index:
        """Select few inputs, gentle to sharp, and all that go straight or turn on the spot."""
        inputs = self._inputs
        special = inputs.straight | (inputs.commands[:, 0] == 0)
        turning = np.flatnonzero(~special)
        curvature = np.abs(inputs.commands[turning, 1] / inputs.commands[turning, 0])
        order = turning[np.argsort(curvature, kind="stable")]
        sides = order.reshape(-1, 4 if (inputs.commands[:, 0] < 0).any() else 2)
        picks = np.unique(np.rint(np.linspace(0, len(sides) - 1, self._settings.shots)).astype(int))
        return np.sort(np.concatenate([np.flatnonzero(special), sides[picks].ravel()]))

    def _left(self, poses: FloatArray, leg: int) -> FloatArray:
        """Lower bound (n,) of the remaining cost from poses (n, 3) on a leg."""
        targets = self._targets[leg:]
        gap = targets[0] - poses[:, :2]
        far = np.hypot(*gap.T)
        if self._fields is not None:
            far = np.maximum(far, self._fields[leg](poses[:, :2]))
        rest = float(np.hypot(*np.diff(targets, axis=0).T).sum())
        bearing = np.arctan2(gap[:, 1], gap[:, 0])
        # Somewhere the robot travels along the chord.
        turn = np.maximum(self._angle(bearing - poses[:, 2]) - self._drift, 0.0)
        if leg == len(self._via):
            turn = turn + np.maximum(self._angle(self._goal[2] - bearing) - self._drift, 0.0)
            least = np.abs(wrap_angle(self._goal[2] - poses[:, 2]))
            turn = np.where(far > _NEAR, np.maximum(turn, least), least)
        else:
            turn = np.where(far > _NEAR, turn, 0.0)
        metre, radian = self._prices
        with np.errstate(invalid="ignore"):
            bounds = (far + rest)[:, None] * metre[1:] + turn[:, None] * radian[1:]
        flat = turn * radian[0]
        return np.asarray(np.maximum(bounds.max(axis=1), flat))

    def _angle(self, angle: FloatArray) -> FloatArray:
        """Return the necessary turn [rad]: less for a robot that goes either way."""
        magnitude = np.abs(wrap_angle(angle))
        return np.minimum(magnitude, np.pi - magnitude) if self._both_ways else magnitude

    def _cheapest(self, words: Words, total: FloatArray, poses: FloatArray, least: float, most: int) -> list[int]:
        """Select at most `most` of the cheapest paths that are free and cheaper than `least`."""
        rows = np.flatnonzero(total < least)
        rows = rows[np.argsort(total[rows], kind="stable")]
        if self._free is None:
            return [int(row) for row in rows[:most]]
        rows = rows[:_TRIED]
        clear = self._are_free(self._free, poses[words.start[rows]], words.inputs[rows], words.times[rows])
        return [int(row) for row in rows[clear][:most]]

    def _are_free(self, free: tuple[ClearanceMap, float], poses: FloatArray, held: Index, times: FloatArray) -> Mask:
        """Return (k,) True if paths of three pieces (k, 3) from poses (k, 3) keep clear."""
        clear, ends = np.ones(len(held), dtype=bool), poses
        for piece in range(held.shape[1]):
            inputs, lasting = held[:, piece], times[:, piece]
            speed, omega = self._inputs.speeds[inputs], np.abs(self._inputs.twists[inputs, 2])
            parts = float((lasting * np.maximum(speed / _CHECK, omega / _CHECK_ANGLE)).max(initial=0.0))
            share = np.linspace(0.0, 1.0, max(2, math.ceil(parts) + 1))
            way = placed(ends[:, None], self._inputs.moved(inputs[:, None], lasting[:, None] * share))
            clear &= free[0].free(way, free[1]).all(axis=1)
            ends = way[:, -1]
        return clear

    def _held(self, words: Words, row: int) -> Held:
        pairs = zip(words.inputs[row].tolist(), words.times[row].tolist(), strict=True)
        return tuple((input_number, time) for input_number, time in pairs if time > 0)

    def _end(self, pose: FloatArray, held: Held) -> FloatArray:
        for input_number, time in held:
            pose = placed(pose, self._inputs.moved(np.array(input_number), np.array(time)))
        return pose

    def _pieces(self, way: list[tuple[Held, int]]) -> tuple[Piece, ...]:
        """Merge consecutive pieces of one input."""
        pieces: list[Piece] = []
        for held, leg in way:
            for input_number, time in held:
                v, omega = self._inputs.commands[input_number].tolist()
                if pieces and pieces[-1][:2] == (v, omega) and pieces[-1].leg == leg:
                    pieces[-1] = pieces[-1]._replace(duration=pieces[-1].duration + time)
                else:
                    pieces.append(Piece(v, omega, time, leg))
        return tuple(pieces)
