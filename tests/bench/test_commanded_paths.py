"""Paths whose curvature jumps, driven without a stop: how far beside them a robot must get, and how far it does."""

import numpy as np
import pytest
from scipy.optimize import linprog

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.mpc.config.schema import Limits

SPEED = 0.5  # m/s, of both paths
STEPS = {"s": 1.0, "cane": 0.7}  # rad/s, by which the yaw rate of the path jumps where it does so furthest


def least_lateral(step: float) -> float:
    """Least possible largest lateral error [m] at a jump of the path's yaw rate, when only the slew of omega limits it.

    The error e follows e'' = v (omega - omega_path); omega may begin to change before the jump. A linear programme.
    """
    dt, count = 0.01, 160
    path = np.where(np.arange(count) < count // 2, 0.0, step)
    # Unknown: omega, heading error and e at each instant, then the bound of |e|.
    shift, keep, none = np.diff(np.eye(count), axis=0), np.eye(count)[:-1], np.zeros((count - 1, count))
    moves = np.block([[-dt * keep, shift, none, none[:, :1]], [none, -dt * SPEED * keep, shift, none[:, :1]]])
    known = np.concatenate([-dt * path[:-1], np.zeros(count - 1)])
    slew = np.hstack([shift, none, none, none[:, :1]])
    errors = np.hstack([np.zeros((count, 2 * count)), np.eye(count)])
    bounded = np.vstack([np.hstack([sign * errors, -np.ones((count, 1))]) for sign in (1.0, -1.0)])
    rest = np.concatenate([np.full(2 * (count - 1), Limits().omega_slew * dt), np.zeros(2 * count)])
    ends = [(None, None)] * (3 * count) + [(0.0, None)]
    for first, values in ((0, path), (count, np.zeros(count)), (2 * count, np.zeros(count))):
        for at in (0, count - 1):
            ends[first + at] = (values[at], values[at])
    cost = np.append(np.zeros(3 * count), 1.0)
    found = linprog(cost, np.vstack([slew, -slew, bounded]), rest, moves, known, bounds=ends, method="highs")
    assert found.status == 0
    return float(found.fun)


@pytest.mark.parametrize("path", STEPS)
@pytest.mark.parametrize("model", ["mbm", "sm", "ssm"])
def test_without_a_stop_it_stays_near_what_geometry_allows(path, model):
    run = run_case(Case(model=model, trajectory=path, timing="commanded", seed=60))
    bound = least_lateral(STEPS[path])
    assert run.metrics.completed
    assert 1e-5 < bound < 0.002
    assert bound < run.metrics.lateral_max_m <= 0.02
