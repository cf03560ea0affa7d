"""Peer acados: one real-time iteration (SQP_RTI) with HPIPM in generated and compiled C; see docs/results.md.

The module runs in the environment of the peers (`studies.speed.process.environment`), so that its only input from this
project are the fields of a `StageProblem`.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

from studies.speed.subjects import SolveReport

_UPDATE = Path(__file__).with_name("acados_update.c")
_HEADER = """#include "acados_solver_tracking.h"
int custom_update_init_function(tracking_solver_capsule *capsule);
int custom_update_function(tracking_solver_capsule *capsule, double *data, int length);
int custom_update_terminate_function(tracking_solver_capsule *capsule);
"""
_UNBOUNDED = 1e8


class AcadosPeer:
    """Solver acados for the whole problem, or for the problem without soft limits.

    Parameters
    ----------
    problem
        Fields of a `studies.speed.stage.StageProblem`.
    settings
        Values of `qp_solver`, `stages_per_block` for partial condensing, `mode` of HPIPM, `tolerance`,
        `max_iterations`, `warm_start`, `shift`, `soft_limits`, and `flags` of the compiler.
    folder
        Folder for the generated and compiled code, which must be the current folder.
    """

    def __init__(self, problem: dict[str, Any], settings: dict[str, Any], folder: Path) -> None:
        self._horizon, self._shift = problem["horizon"], float(settings["shift"])
        self._step = ca.Function.deserialize(problem["step"])
        ocp = _ocp(problem, settings)
        shutil.copyfile(_UPDATE, folder / _UPDATE.name)
        (folder / "acados_update.h").write_text(_HEADER, encoding="utf-8")
        ocp.solver_options.custom_update_filename = _UPDATE.name
        ocp.solver_options.custom_update_header_filename = "acados_update.h"
        ocp.solver_options.custom_update_copy = True
        self._solver = AcadosOcpSolver(ocp, json_file="ocp.json", verbose=False)
        self._data = np.zeros(1 + problem["states"] + (self._horizon + 1) * problem["parameters"])
        self._status = 0

    def reset(self, state: np.ndarray, parameters: np.ndarray) -> None:
        """Reset the solver; the initial guess follows the feed-forward."""
        self._solver.reset()
        self._data[0] = 0.0
        z = state
        for k in range(self._horizon):
            u = parameters[k, 4:6]
            self._solver.set(k, "x", z)
            self._solver.set(k, "u", u)
            z = np.array(self._step(z, u, parameters[k])).ravel()
        self._solver.set(self._horizon, "x", z)

    def solve(self, state: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Compute the command (2,) for the first state and the parameters of all stages."""
        data = self._data
        parameters_start = 1 + len(state)
        data[1:parameters_start] = state
        data[parameters_start:] = parameters.ravel()
        self._solver.custom_update(data)
        data[0] = self._shift
        self._status = self._solver.solve()
        return np.asarray(self._solver.get(0, "u"))

    def report(self) -> SolveReport:
        """Return the report of the last solve."""
        iterations = int(np.sum(self._solver.get_stats("qp_iter")))
        return SolveReport(float(np.ravel(self._solver.get_stats("time_tot"))[0]), iterations, self._status == 0)


def _ocp(problem: dict[str, Any], settings: dict[str, Any]) -> AcadosOcp:
    N, size = problem["horizon"], problem["states"]
    z, u, p = ca.SX.sym("z", size), ca.SX.sym("u", 2), ca.SX.sym("p", problem["parameters"])
    step, tracking, effort, soft = (
        ca.Function.deserialize(problem[name]) for name in ("step", "tracking", "effort", "soft_values")
    )
    model = AcadosModel()
    model.name, model.x, model.u, model.p = "tracking", z, u, p
    model.disc_dyn_expr = step(z, u, p)
    model.cost_y_expr_0 = effort(z, u, p)
    model.cost_y_expr = ca.vertcat(tracking(z, p), effort(z, u, p))
    model.cost_y_expr_e = tracking(z, p)
    ocp = AcadosOcp()
    ocp.model, ocp.dims.N, ocp.parameter_values = model, N, np.zeros(problem["parameters"])
    cost = ocp.cost
    cost.cost_type_0 = cost.cost_type = cost.cost_type_e = "NONLINEAR_LS"
    cost.W_0 = np.diag(problem["effort_weights"])
    cost.W = np.diag(np.concatenate([problem["tracking_weights"], problem["effort_weights"]]))
    cost.W_e = problem["terminal"] * np.diag(problem["tracking_weights"])
    cost.yref_0, cost.yref, cost.yref_e = np.zeros(4), np.zeros(7), np.zeros(3)
    limits = ocp.constraints
    limits.x0 = np.zeros(size)
    limits.idxbu, limits.lbu, limits.ubu = np.arange(2), -problem["box"], problem["box"]
    limits.D, limits.C = np.eye(2), np.zeros((2, size))
    limits.C[:, -2:] = -np.eye(2)
    limits.lg, limits.ug = -problem["slew"], problem["slew"]
    if settings["soft_limits"]:
        model.con_h_expr = model.con_h_expr_e = soft(z, p)
        limits.lh = limits.lh_e = np.full(5, -_UNBOUNDED)
        limits.uh = limits.uh_e = np.full(5, _UNBOUNDED)
        limits.idxsh = limits.idxsh_e = np.arange(5)
        linear, quadratic = np.full(5, problem["soft"]), np.full(5, problem["soft_quadratic"])
        cost.zl = cost.zu = cost.zl_e = cost.zu_e = linear
        cost.Zl = cost.Zu = cost.Zl_e = cost.Zu_e = quadratic
    options = ocp.solver_options
    # acados multiplies the cost of a stage by its duration, which is 1 s for N seconds in N steps.
    options.tf = float(N)
    options.integrator_type, options.nlp_solver_type, options.hessian_approx = "DISCRETE", "SQP_RTI", "GAUSS_NEWTON"
    options.qp_solver = settings["qp_solver"]
    options.qp_solver_cond_N = -(-N // settings["stages_per_block"])
    options.hpipm_mode = settings["mode"]
    options.qp_solver_tol_stat = options.qp_solver_tol_eq = settings["tolerance"]
    options.qp_solver_tol_ineq = options.qp_solver_tol_comp = settings["tolerance"]
    options.qp_solver_iter_max = settings["max_iterations"]
    options.qp_solver_warm_start = settings["warm_start"]
    options.ext_fun_compile_flags = settings["flags"]
    options.print_level = 0
    return ocp
