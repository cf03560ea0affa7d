"""Tracking problem as a nonlinear program by multiple shooting, for the solvers of CasADi."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

SOFT_VALUES = 5
"""Number of values with soft limits at each stage."""


@dataclass(frozen=True)
class ShootingProgram:
    """Nonlinear program in x = (z_0, u_0, s_1, z_1, u_1, ..., s_N, z_N) with p = (z_0, p_0, ..., p_N).

    The slacks s_k >= 0 are the violations of the soft limits of stage k. The program is expanded into scalars: the
    derivatives of one function that is mapped over the horizon take several times as long to evaluate.

    Attributes
    ----------
    nlp
        Expressions x, p, f and g for `casadi.nlpsol`.
    bounds
        Bounds lbx, ubx, lbg and ubg.
    equality
        Flag of each row of g, True for equations.
    stride, states
        Number of values of a stage in x, and length of z; u_k follows z_k.
    """

    nlp: dict[str, ca.SX]
    bounds: dict[str, np.ndarray]
    equality: list[bool]
    stride: int
    states: int

    def guess(self, states: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Stack states (N + 1, z), commands (N, 2) and slacks of zero to x."""
        slack = np.zeros((len(commands), SOFT_VALUES))
        return np.concatenate([np.column_stack([states[:-1], commands, slack]).ravel(), states[-1]])

    def shift(self, x: np.ndarray) -> np.ndarray:
        """Shift x by one stage and repeat the last stage."""
        return np.concatenate([x[self.stride :], x[-self.stride :]])

    def command(self, x: np.ndarray) -> np.ndarray:
        """Extract the first command (2,)."""
        return np.asarray(x[self.states : self.states + 2])


def shooting_program(problem: dict[str, Any]) -> ShootingProgram:
    """Build the program for the fields of a `studies.speed.stage.StageProblem`."""
    N, size = problem["horizon"], problem["states"]
    stride = size + 2 + SOFT_VALUES
    stage, terminal_tracking = _stage(problem), ca.Function.deserialize(problem["tracking"])
    x = ca.SX.sym("x", stride * N + size)
    first_state, parameters = ca.SX.sym("first", size), ca.SX.sym("p", problem["parameters"], N + 1)
    g, cost = [], ca.SX(0)
    for k in range(N):
        next_z = x[stride * (k + 1) :][:size]
        rows, stage_cost = stage(x[stride * k :][:stride], next_z, parameters[:, k], parameters[:, k + 1])
        g.append(rows)
        if k == 0:
            g.append(x[:size] - first_state)
        cost += stage_cost
    # The cost of the last stage already contains its tracking error once; the factor must be `terminal`.
    weights = (problem["terminal"] - 1.0) * problem["tracking_weights"]
    cost += ca.dot(weights, terminal_tracking(next_z, parameters[:, N]) ** 2) / 2

    unbounded, zeros = np.full(size, np.inf), np.zeros(size)
    low = np.concatenate([zeros, -problem["slew"], np.full(SOFT_VALUES, -np.inf), np.zeros(SOFT_VALUES)])
    high = np.concatenate([zeros, problem["slew"], np.zeros(SOFT_VALUES), np.full(SOFT_VALUES, np.inf)])
    equations = [True] * size + [False] * (len(low) - size)
    box = problem["box"]
    lower = np.concatenate([-unbounded, -box, np.zeros(SOFT_VALUES)])
    upper = np.concatenate([unbounded, box, np.full(SOFT_VALUES, np.inf)])
    return ShootingProgram(
        nlp={"x": x, "p": ca.vertcat(first_state, ca.vec(parameters)), "f": cost, "g": ca.vertcat(*g)},
        bounds={
            "lbx": np.concatenate([np.tile(lower, N), -unbounded]),
            "ubx": np.concatenate([np.tile(upper, N), unbounded]),
            "lbg": np.concatenate([low, zeros, np.tile(low, N - 1)]),
            "ubg": np.concatenate([high, zeros, np.tile(high, N - 1)]),
        },
        equality=equations + [True] * size + equations * (N - 1),
        stride=stride,
        states=size,
    )


def _stage(problem: dict[str, Any]) -> ca.Function:
    """Build the function that maps a stage (z, u, s), the next z and the parameters to rows of g and the cost."""
    size, soft_limit = problem["states"], slice(problem["parameters"] - SOFT_VALUES, problem["parameters"])
    step, tracking, effort, soft = (
        ca.Function.deserialize(problem[name]) for name in ("step", "tracking", "effort", "soft_values")
    )
    stage, next_z = ca.SX.sym("stage", size + 2 + SOFT_VALUES), ca.SX.sym("next_z", size)
    p, next_p = (ca.SX.sym(name, problem["parameters"]) for name in ("p", "next_p"))
    z, u, s = stage[:size], stage[size : size + 2], stage[size + 2 :]
    predicted_z = step(z, u, p)
    # The soft limits apply to `predicted_z` instead of `next_z`, because the inequalities of a stage may depend only on
    # this stage.
    values, limits = soft(predicted_z, next_p), next_p[soft_limit]
    rows = ca.vertcat(next_z - predicted_z, u - z[-2:], values - limits - s, values + limits + s)
    cost = ca.dot(problem["effort_weights"], effort(z, u, p) ** 2) / 2
    cost += ca.dot(problem["tracking_weights"], tracking(next_z, next_p) ** 2) / 2
    cost += problem["soft"] * ca.sum1(s) + problem["soft_quadratic"] * ca.sumsqr(s) / 2
    return ca.Function("stage", [stage, next_z, p, next_p], [rows, cost])
