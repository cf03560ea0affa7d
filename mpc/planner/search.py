"""Sampling-based A* over inputs: the shape of the way.

After SBMPO (Sampling-Based Model Predictive Optimization), with which Ordonez et al., 2017 (P4), section 4.3, plan: a
graph grows by sampled inputs through the slip-calibrated kinematics, the cheapest state first by what it cost and a
lower bound of what is left. Added here: of states in one cell of the grid the cheapest is kept; from every state the
goal is tried in closed form (`words`), so that the end is exact and the best way known bounds the search at any time.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.planner.clearance import ClearanceMap
from diffdrive_mpc.mpc.planner.inputs import Inputs
from diffdrive_mpc.mpc.planner.settings import SearchSettings
from diffdrive_mpc.mpc.planner.words import Words, arc_arc_arc, arc_straight, arc_straight_arc, placed

# Between two poses that are held against the map [m, rad].
_CHECK, _CHECK_ANGLE = 0.12, 0.3
# Within this distance of a target its direction tells no turn that has to be made [m].
_NEAR = 0.3
# So many ways from a batch are held against the map, cheapest first.
_TRIED = 60


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


class Found(NamedTuple):
    """What the search has to say."""

    pieces: tuple[Piece, ...]
    cost: float
    """of the objective, without speeding up and slowing down"""
    bound: float
    """no sequence of the sampled inputs is cheaper"""
    states: int
    """that were taken up"""
    complete: bool
    """whether it ended because nothing can be better by more than the gap"""


class Search:
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
        How.
    free
        Map of clearances and the margin [m]; None where there is nothing to keep clear of.
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
        self._fields = None if free is None else [free[0].distances(one, free[1]) for one in self._targets]
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
        # A body that drifts sideways does not travel where it points.
        moving = inputs.twists[inputs.speeds > 1e-9]
        drift = np.arctan2(moving[:, 1], np.abs(moving[:, 0]))
        self._drift = float(np.abs(drift).max())
        self._both_ways = bool((inputs.commands[:, 0] < 0).any())

    def reachable(self) -> bool:
        """Whether there is a way for a point through everything; turns are not looked at."""
        if self._fields is None:
            return True
        points = np.concatenate([self._start[None, :2], self._via])
        return all(bool(np.isfinite(field(point[None]))[0]) for field, point in zip(self._fields, points, strict=True))

    def run(self) -> Found | None:
        """Search; None where no way was found."""
        asked, inputs = self._settings, self._inputs
        poses, costs, legs = [self._start], [0.0], [0]
        parents: list[tuple[int, tuple[tuple[int, float], ...]]] = [(-1, ())]
        best: dict[tuple[int, ...], float] = {}
        heap = [(float(self._left(self._start[None], 0)[0]), 0)]
        ending: tuple[int, tuple[tuple[int, float], ...]] | None = None
        least, count = np.inf, 0
        taken_keys: set[tuple[int, ...]] = set()
        while heap and count < asked.most_states:
            if heap[0][0] >= least * (1 - asked.gap):
                break
            batch: list[int] = []
            while heap and len(batch) < (asked.batch if count else 1):
                if heap[0][0] >= least * (1 - asked.gap):
                    break
                _, node = heapq.heappop(heap)
                key = self._key(poses[node], legs[node])
                if key in taken_keys and node:
                    continue
                taken_keys.add(key)
                batch.append(node)
            if not batch:
                break
            for leg in sorted({legs[node] for node in batch}):
                nodes = [node for node in batch if legs[node] == leg]
                at, so_far = np.array([poses[node] for node in nodes]), np.array([costs[node] for node in nodes])
                last = leg == len(self._via)
                words = self._words(at, leg, whole=count == 0)
                total = so_far[words.start] + words.costs
                if last:
                    for row in self._cheapest(words, total, at, least, 1):
                        least = float(total[row])
                        ending = nodes[words.start[row]], self._held(words, row)
                else:
                    # Ways to a via point are states of the next leg.
                    for row in self._cheapest(words, total, at, least, 4 * len(nodes)):
                        held = self._held(words, row)
                        pose = self._end(at[words.start[row]], held)
                        pose[:2] = self._via[leg]
                        estimate = float(total[row] + self._left(pose[None], leg + 1)[0])
                        if estimate < least * (1 - asked.gap) and self._better(best, pose, leg + 1, float(total[row])):
                            poses.append(pose)
                            costs.append(float(total[row]))
                            legs.append(leg + 1)
                            parents.append((nodes[words.start[row]], held))
                            heapq.heappush(heap, (estimate, len(poses) - 1))
                after = placed(at[:, None], self._moved[None])
                reached = so_far[:, None] + inputs.rates * self._times
                left = self._left(after.reshape(-1, 3), leg).reshape(reached.shape)
                worth = reached + left < least * (1 - asked.gap)
                rows, used = np.nonzero(worth)
                if self._free is not None and len(rows):
                    way = placed(at[rows, None], self._inside[used])
                    clear = self._free[0].free(way, self._free[1]).all(axis=1)
                    rows, used = rows[clear], used[clear]
                for row, one in zip(rows.tolist(), used.tolist(), strict=True):
                    pose, cost = after[row, one], float(reached[row, one])
                    if not self._better(best, pose, leg, cost):
                        continue
                    poses.append(pose)
                    costs.append(cost)
                    legs.append(leg)
                    parents.append((nodes[row], ((one, float(self._times[one])),)))
                    heapq.heappush(heap, (cost + float(left[row, one]), len(poses) - 1))
            count += len(batch)
        if ending is None:
            return None
        # What is still open, or was broken off at, says how cheap a way could be at best.
        open_bound = heap[0][0] if heap else least
        done = open_bound >= least * (1 - asked.gap)
        return Found(self._traced(ending, parents, legs), least, min(least, open_bound), count, done)

    def _words(self, poses: FloatArray, leg: int, *, whole: bool) -> Words:
        """Ways to the end of the leg: of every input and three arcs from the start, of few inputs from elsewhere."""
        if leg < len(self._via):
            return arc_straight(self._inputs, poses, self._via[leg])
        if whole:
            every = [arc_straight_arc(self._inputs, poses, self._goal), self._of_few(arc_arc_arc, poses)]
            return Words(*(np.concatenate(parts) for parts in zip(*every, strict=True)))
        return self._of_few(arc_straight_arc, poses)

    def _of_few(self, kind: Callable[[Inputs, FloatArray, FloatArray], Words], poses: FloatArray) -> Words:
        """Ways of few inputs, by the numbers that these have among all."""
        words = kind(self._shots, poses, self._goal)
        return words._replace(inputs=self._shot_rows[words.inputs])

    def _few(self) -> FloatArray:
        """Numbers of few inputs, gentle to sharp, all that go straight on or turn on the spot among them."""
        inputs = self._inputs
        special = inputs.straight | (inputs.speeds < 1e-6)
        turning = np.flatnonzero(~special)
        order = turning[np.argsort(np.abs(inputs.commands[turning, 1] / inputs.commands[turning, 0]), kind="stable")]
        sides = order.reshape(-1, 4 if (inputs.commands[:, 0] < 0).any() else 2)
        picks = np.unique(np.rint(np.linspace(0, len(sides) - 1, self._settings.shots)).astype(int))
        return np.sort(np.concatenate([np.flatnonzero(special), sides[picks].ravel()]))

    def _left(self, poses: FloatArray, leg: int) -> FloatArray:
        """Lower bound (n,) of what is left from poses (n, 3) on a leg."""
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
        return np.maximum(bounds.max(axis=1), flat)

    def _angle(self, angle: FloatArray) -> FloatArray:
        """Turn that has to be made [rad]: less for a robot that goes either way."""
        found = np.abs(wrap_angle(angle))
        return np.minimum(found, np.pi - found) if self._both_ways else found

    def _key(self, pose: FloatArray, leg: int) -> tuple[int, ...]:
        asked = self._settings
        heading = round(float(pose[2]) / (2 * np.pi) * asked.headings) % asked.headings
        return leg, round(float(pose[0]) / asked.cell), round(float(pose[1]) / asked.cell), heading

    def _better(self, best: dict[tuple[int, ...], float], pose: FloatArray, leg: int, cost: float) -> bool:
        key = self._key(pose, leg)
        if cost >= best.get(key, np.inf):
            return False
        best[key] = cost
        return True

    def _cheapest(self, words: Words, total: FloatArray, poses: FloatArray, least: float, most: int) -> list[int]:
        """Numbers of the cheapest ways that are free and cheaper than `least`, at most so many."""
        rows = np.flatnonzero(total < least)
        rows = rows[np.argsort(total[rows], kind="stable")]
        if self._free is None:
            return [int(row) for row in rows[:most]]
        kept: list[int] = []
        for row in rows[:_TRIED]:
            if self._is_free(poses[words.start[row]], words.inputs[row], words.times[row]):
                kept.append(int(row))
                if len(kept) == most:
                    break
        return kept

    def _is_free(self, pose: FloatArray, inputs: FloatArray, times: FloatArray) -> bool:
        assert self._free is not None
        at = pose
        for one, time in zip(inputs.tolist(), times.tolist(), strict=True):
            speed, omega = self._inputs.speeds[one], abs(self._inputs.twists[one, 2])
            parts = max(1, int(np.ceil(time * max(speed / _CHECK, omega / _CHECK_ANGLE))))
            moved = self._inputs.moved(np.full(parts, one), time * np.arange(1, parts + 1) / parts)
            way = placed(at, moved)
            if not self._free[0].free(way, self._free[1]).all():
                return False
            at = way[-1]
        return True

    def _held(self, words: Words, row: int) -> tuple[tuple[int, float], ...]:
        pairs = zip(words.inputs[row].tolist(), words.times[row].tolist(), strict=True)
        return tuple((one, time) for one, time in pairs if time > 0)

    def _end(self, pose: FloatArray, held: tuple[tuple[int, float], ...]) -> FloatArray:
        for one, time in held:
            pose = placed(pose, self._inputs.moved(np.array(one), np.array(time)))
        return pose

    def _traced(
        self,
        ending: tuple[int, tuple[tuple[int, float], ...]],
        parents: list[tuple[int, tuple[tuple[int, float], ...]]],
        legs: list[int],
    ) -> tuple[Piece, ...]:
        """Pieces from the start, those of one input that follow one another as one."""
        node, held = ending
        parts = [(held, len(self._via))]
        while node > 0:
            before, held = parents[node]
            parts.append((held, legs[before]))
            node = before
        pieces: list[Piece] = []
        for held, leg in reversed(parts):
            for one, time in held:
                v, omega = self._inputs.commands[one].tolist()
                if pieces and pieces[-1][:2] == (v, omega) and pieces[-1].leg == leg:
                    pieces[-1] = pieces[-1]._replace(duration=pieces[-1].duration + time)
                else:
                    pieces.append(Piece(v, omega, time, leg))
        return tuple(pieces)
