"""The program of a tick as `Controller.quadratic_program` states it, given to other solvers."""

import casadi as ca
import daqp
import numpy as np
import osqp
import pytest

from diffdrive_mpc import Controller, Term, load_config, load_trajectory, make_plant

SLOW = {"limits.v_slew": 0.9, "limits.omega_slew": 1.5}


def by_osqp(qp):
    solver = osqp.OSQP()
    settings = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000, "polishing": True, "verbose": False}
    solver.setup(qp.P, qp.q, qp.A, qp.l, qp.u, **settings)
    return np.array(solver.solve(raise_error=True).x)


def by_daqp(qp):
    rows = [np.ascontiguousarray(part) for part in (qp.P.toarray(), qp.q, qp.A.toarray(), qp.u, qp.l)]
    plan, _, flag, _ = daqp.solve(*rows, np.zeros(len(qp.l), dtype=np.int32), primal_tol=1e-10, dual_tol=1e-12)
    assert flag == 1
    return plan


def ticks(config, path, count, seed=0, terms=()):
    controller = Controller(config, terms=terms)
    plant, reference = make_plant("model:ssm", seed=seed), load_trajectory(path)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    for _ in range(count):
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
        if step.solver.method in ("active_set", "unlimited"):
            yield controller.quadratic_program(), step


@pytest.mark.parametrize(
    ("path", "limits"),
    [("circle", {"limits.omega": 0.51, "limits.predicted_v": 0.48}), ("square", {"limits.wheel_speed": 0.45})],
)
def test_osqp_daqp_and_the_product_agree_on_the_program_of_a_tick(path, limits):
    """With soft limits exceeded, too: the slacks are then what the plan exceeds them by."""
    config = load_config("ssm", SLOW | limits | {"horizon": 12, "weights.soft": 3.0, "weights.soft_quadratic": 20.0})
    methods = set()
    for qp, step in list(ticks(config, path, 120))[::4]:
        n = 2 * config.horizon
        plan = step.planned_commands.reshape(-1)
        assert by_osqp(qp)[:n] == pytest.approx(plan, abs=1e-6)
        assert by_daqp(qp)[:n] == pytest.approx(plan, abs=1e-6)
        methods.add(step.solver.method)
    assert "active_set" in methods


def test_rows_and_variables_are_named_by_kind_and_step():
    config = load_config("ssm", {"horizon": 8, "limits.min_turn_radius": 0.3, "limits.v": 0.7})
    pose = ca.SX.sym("pose", 3)
    near = Term("near", ca.Function("near", [pose], [pose[0]], ["pose"], ["value"]), "soft", upper=1.0)
    qp, step = next(ticks(config, "s", 5, terms=(near,)))
    n, m = len(qp.variables), len(qp.rows)
    assert qp.P.shape == (n, n) and qp.q.shape == (n,) and qp.A.shape == (m, n) and qp.l.shape == qp.u.shape == (m,)
    assert (qp.P != qp.P.T).nnz == 0
    values = qp.A @ np.append(step.planned_commands.reshape(-1), np.zeros(n - 16))
    row = qp.rows.index("v[3]")
    assert (values[row], qp.l[row], qp.u[row]) == (step.planned_commands[3, 0], -0.7, 0.7)
    increment = values[qp.rows.index("omega_increment[2]")]
    assert increment == pytest.approx(step.planned_commands[2, 1] - step.planned_commands[1, 1])
    assert {"soft turn right[0]", "soft near.0[7]", "under soft across[0]"} <= set(qp.rows)
