"""The problem as a nonlinear program by multiple shooting, for the solvers of CasADi."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

SOFT = 5
"""Number of values with soft limits at each stage."""


@dataclass(frozen=True)
class ShootingProgram:
    """Nonlinear program in x = (z_0, u_0, s_1, z_1, u_1, ..., s_N, z_N) with p = (z_0, p_0, ..., p_N).

    s_k >= 0 are the violations of the soft limits of stage k. The program is expanded into scalars: a map of one stage
    over the horizon needs less code, but its derivatives are several times slower to evaluate.

    Attributes
    ----------
    nlp
        x, p, f, g for `casadi.nlpsol`.
    bounds
        lbx, ubx, lbg, ubg.
    equality
        Rows of g that are equations.
    stride, states
        Number of values of a stage in x, and of z; u_k follows z_k.
    """

    nlp: dict[str, ca.SX]
    bounds: dict[str, np.ndarray]
    equality: list[bool]
    stride: int
    states: int

    def guess(self, states: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Stack the states (N + 1, z), the commands (N, 2) and zero slacks to x."""
        slack = np.zeros((len(commands), SOFT))
        return np.concatenate([np.column_stack([states[:-1], commands, slack]).ravel(), states[-1]])

    def shifted(self, x: np.ndarray) -> np.ndarray:
        """Shift x by one stage and repeat the last stage."""
        return np.concatenate([x[self.stride :], x[-self.stride :]])

    def command(self, x: np.ndarray) -> np.ndarray:
        """Extract the first command (2,)."""
        return np.asarray(x[self.states : self.states + 2])


def shooting_program(problem: dict[str, Any]) -> ShootingProgram:
    """Build the program for the fields of a `studies.speed.stage.StageProblem`."""
    N, size = problem["horizon"], problem["states"]
    stride = size + 2 + SOFT
    stage, last = _stage(problem), ca.Function.deserialize(problem["tracking"])
    x = ca.SX.sym("x", stride * N + size)
    first, parameters = ca.SX.sym("first", size), ca.SX.sym("p", problem["parameters"], N + 1)
    g, cost = [], ca.SX(0)
    for k in range(N):
        after = x[stride * (k + 1) :][:size]
        rows, stage_cost = stage(x[stride * k :][:stride], after, parameters[:, k], parameters[:, k + 1])
        g.append(rows)
        if k == 0:
            g.append(x[:size] - first)
        cost += stage_cost
    # The cost of the last stage contains its end with the weight 1; add the rest of the weight `terminal`.
    weights = (problem["terminal"] - 1.0) * problem["tracking_weights"]
    cost += ca.dot(weights, last(after, parameters[:, N]) ** 2) / 2

    free, none = np.full(size, np.inf), np.zeros(size)
    low = np.concatenate([none, -problem["slew"], np.full(SOFT, -np.inf), np.zeros(SOFT)])
    high = np.concatenate([none, problem["slew"], np.zeros(SOFT), np.full(SOFT, np.inf)])
    equations = [True] * size + [False] * (len(low) - size)
    box = problem["box"]
    lower, upper = np.concatenate([-free, -box, np.zeros(SOFT)]), np.concatenate([free, box, np.full(SOFT, np.inf)])
    return ShootingProgram(
        nlp={"x": x, "p": ca.vertcat(first, ca.vec(parameters)), "f": cost, "g": ca.vertcat(*g)},
        bounds={
            "lbx": np.concatenate([np.tile(lower, N), -free]),
            "ubx": np.concatenate([np.tile(upper, N), free]),
            "lbg": np.concatenate([low, none, np.tile(low, N - 1)]),
            "ubg": np.concatenate([high, none, np.tile(high, N - 1)]),
        },
        equality=equations + [True] * size + equations * (N - 1),
        stride=stride,
        states=size,
    )


def _stage(problem: dict[str, Any]) -> ca.Function:
    """Build the function that maps (z, u, s) of a stage, the next z and the parameters to rows of g and the cost."""
    size, soft_limit = problem["states"], slice(problem["parameters"] - SOFT, problem["parameters"])
    step, tracking, effort, soft = (
        ca.Function.deserialize(problem[name]) for name in ("step", "tracking", "effort", "soft_values")
    )
    stage, after = ca.SX.sym("here", size + 2 + SOFT), ca.SX.sym("after", size)
    p, p_after = (ca.SX.sym(name, problem["parameters"]) for name in ("p", "p_after"))
    z, u, s = stage[:size], stage[size : size + 2], stage[size + 2 :]
    end = step(z, u, p)
    # The soft limits apply to `end` and not to `after`, because the inequalities of a stage may depend on this stage
    # only.
    values, limits = soft(end, p_after), p_after[soft_limit]
    rows = ca.vertcat(after - end, u - z[-2:], values - limits - s, values + limits + s)
    cost = ca.dot(problem["effort_weights"], effort(z, u, p) ** 2) / 2
    cost += ca.dot(problem["tracking_weights"], tracking(after, p_after) ** 2) / 2
    cost += problem["soft"] * ca.sum1(s) + problem["soft_quadratic"] * ca.sumsqr(s) / 2
    return ca.Function("stage", [stage, after, p, p_after], [rows, cost])
