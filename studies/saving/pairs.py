"""Starts and goals, drawn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from studies.saving.settings import Drawn

Pose = tuple[float, float, float]
"""x, y [m], theta [rad]."""


class Pair(NamedTuple):
    """Where the robot rests at first and in the end."""

    start: Pose
    goal: Pose

    @property
    def distance(self) -> float:
        """Straight from one to the other [m]."""
        return float(np.hypot(self.goal[0] - self.start[0], self.goal[1] - self.start[1]))


def draw_pairs(asked: Drawn, count: int, seed: int) -> list[Pair]:
    """So many pairs from a seed: distance, where the goal lies, and where the robot is to look there.

    A Latin hypercube: each of the three is spread evenly over its range, one pair to each of `count` slices, so that
    neither near goals nor goals straight ahead can be in the majority. A floor is the same everywhere: all start at
    the origin and look along x.
    """
    unit = qmc.LatinHypercube(d=3, seed=np.random.default_rng(seed)).random(count)
    low, high = np.array([[asked.distance[0], -np.pi, -np.pi], [asked.distance[1], np.pi, np.pi]])
    rows = low + unit * (high - low)
    return [
        Pair((0.0, 0.0, 0.0), (float(far * np.cos(bearing)), float(far * np.sin(bearing)), float(heading)))
        for far, bearing, heading in rows
    ]
