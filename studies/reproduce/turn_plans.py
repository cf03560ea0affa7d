"""How long the planner takes beside P4's SBMPO: plans of least energy within 10 m by 10 m at 0.6 m/s, as there."""

from __future__ import annotations

import contextlib
import math
import time

import numpy as np

from diffdrive_mpc.extras.planner import PlanError, plan
from diffdrive_mpc.models.turn_costs import load_turn_costs

_AREA, _SPEED, _FROM = 10.0, 0.6, 6.0


def planning_times(costs: str, count: int, seed: int) -> tuple[float, ...]:
    """Processor times of `count` plans [s] with the turn costs of that name, each from a corner to a goal ahead.

    The heading at the goal is that of the straight line, turned by up to a quarter of a circle. A goal that cannot be
    planned takes its time, too.
    """
    rng, robot, took = np.random.default_rng(seed), load_turn_costs(costs), []
    for _ in range(count):
        goal = rng.uniform([_FROM, 0.0], _AREA)
        heading = math.atan2(goal[1], goal[0]) + rng.uniform(-math.pi / 4, math.pi / 4)
        begin = time.process_time()
        with contextlib.suppress(PlanError):
            plan(robot, [0.0, 0.0, 0.0], [*goal, heading], minimise="energy", speed=_SPEED)
        took.append(time.process_time() - begin)
    return tuple(took)
