"""Peer do-mpc with IPOPT; see docs/results.md.

The module runs in the environment of the peers (`studies.speed.process.environment`), so that its only input from this
project are the fields of a `StageProblem`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from do_mpc.controller import MPC
from do_mpc.model import Model

from studies.speed.subjects import SolveReport
from studies.speed.subjects.shooting import SOFT_VALUES


class DoMpcPeer:
    """Solver do-mpc for the whole problem; the slacks of soft limits are additional inputs of the model.

    Parameters
    ----------
    problem
        Fields of a `studies.speed.stage.StageProblem`.
    settings
        Options of IPOPT.
    folder
        Not used, because no code is generated.
    """

    def __init__(self, problem: dict[str, Any], settings: dict[str, Any], folder: Path) -> None:
        del folder
        self._horizon = problem["horizon"]
        mpc = MPC(_model(problem))
        mpc.settings.n_horizon, mpc.settings.t_step = self._horizon, 1.0
        mpc.settings.store_full_solution = False
        mpc.settings.store_lagr_multiplier = False
        mpc.settings.nlpsol_opts = {**settings, "print_time": False, "record_time": True}
        model = mpc.model
        z, u, s = model.x["state"], model.u["command"], model.u["slack"]
        p, p_next = model.tvp["stage"], model.tvp["next_stage"]
        tracking = ca.Function.deserialize(problem["tracking"])(z, p)
        stage = ca.dot(problem["tracking_weights"], tracking**2) / 2
        effort = ca.Function.deserialize(problem["effort"])(z, u, p)
        stage_cost = stage + ca.dot(problem["effort_weights"], effort**2) / 2
        stage_cost += problem["soft"] * ca.sum1(s) + problem["soft_quadratic"] * ca.sumsqr(s) / 2
        mpc.set_objective(mterm=problem["terminal"] * stage, lterm=stage_cost)
        mpc.bounds["lower", "_u", "command"], mpc.bounds["upper", "_u", "command"] = -problem["box"], problem["box"]
        mpc.bounds["lower", "_u", "slack"] = np.zeros(SOFT_VALUES)
        increment = u - z[-2:]
        mpc.set_nl_cons("up", increment, ub=problem["slew"])
        mpc.set_nl_cons("down", -increment, ub=problem["slew"])
        z_next = ca.Function.deserialize(problem["step"])(z, u, p)
        values, limits = ca.Function.deserialize(problem["soft_values"])(z_next, p_next), p_next[-SOFT_VALUES:]
        mpc.set_nl_cons("above", values - limits - s, ub=0.0)
        mpc.set_nl_cons("below", -values - limits - s, ub=0.0)
        self._data = mpc.get_tvp_template()
        mpc.set_tvp_fun(lambda _: self._data)
        mpc.setup()
        self._mpc = mpc

    def reset(self, state: np.ndarray, parameters: np.ndarray) -> None:
        """Reset the solver; the initial guess is the feed-forward of the first stage."""
        mpc = self._mpc
        mpc.reset_history()
        mpc.x0["state"] = state
        mpc.u0["command"], mpc.u0["slack"] = parameters[0, 4:6], np.zeros(SOFT_VALUES)
        mpc.set_initial_guess()

    def solve(self, state: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Compute the command (2,) for the first state and the parameters of all stages."""
        next_parameters = np.vstack([parameters[1:], parameters[-1:]])
        self._data.master = ca.DM(np.hstack([parameters, next_parameters]).ravel())
        return np.asarray(self._mpc.make_step(state)[:2, 0])

    def report(self) -> SolveReport:
        """Return the report of the last solve."""
        stats = self._mpc.solver_stats
        return SolveReport(float(stats["t_wall_total"]), int(stats["iter_count"]), bool(stats["success"]))


def _model(problem: dict[str, Any]) -> Model:
    model = Model("discrete", "SX")
    z = model.set_variable("_x", "state", (problem["states"], 1))
    u = model.set_variable("_u", "command", (2, 1))
    model.set_variable("_u", "slack", (SOFT_VALUES, 1))
    p = model.set_variable("_tvp", "stage", (problem["parameters"], 1))
    model.set_variable("_tvp", "next_stage", (problem["parameters"], 1))
    model.set_rhs("state", ca.Function.deserialize(problem["step"])(z, u, p))
    model.setup()
    return model
