"""`Controller.quadratic_program` and `casadi_problem`, compared with other solvers and the oracle."""

from dataclasses import replace

import casadi as ca
import daqp
import numpy as np
import osqp
import pytest
from nonlinear_program import saturating, solve_with_ipopt
from test_oracle_problem import EXTRA, setting

from diffdrive_mpc import (
    Controller,
    Measurement,
    Term,
    casadi_problem,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
)
from oracle.nonlinear import nonlinear_program

SLOW = {"limits.v_slew": 0.9, "limits.omega_slew": 1.5}


def solve_with_osqp(qp):
    solver = osqp.OSQP()
    settings = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000, "polishing": True, "verbose": False}
    solver.setup(qp.P, qp.q, qp.A, qp.l, qp.u, **settings)
    return np.array(solver.solve(raise_error=True).x)


def solve_with_daqp(qp):
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
    """If soft limits are exceeded, the slacks equal the excess of the plan."""
    config = load_config("ssm", SLOW | limits | {"horizon": 12, "weights.soft": 3.0, "weights.soft_quadratic": 20.0})
    methods = set()
    for qp, step in list(ticks(config, path, 120))[::4]:
        n = 2 * config.horizon
        plan = step.planned_commands.reshape(-1)
        assert solve_with_osqp(qp)[:n] == pytest.approx(plan, abs=1e-6)
        assert solve_with_daqp(qp)[:n] == pytest.approx(plan, abs=1e-6)
        methods.add(step.solver.method)
    assert "active_set" in methods


def test_names_of_rows_and_variables_contain_kind_and_step():
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


# The nonlinear problem in CasADi, compared with the oracle and the compiled plan.


CURVED = {"estimator.crab": 0.02, "estimator.veer": 0.05, "estimator.track_growth": 0.1}


def drive(config, model=None, ticks=155):
    controller, robot, square = Controller(config, model), make_plant("model:ssm", seed=1), load_trajectory("square")
    robot.reset(square.sample([0.0]).pose[0])
    controller.start(square, robot.time)
    for _ in range(ticks):
        step = controller.step(robot.time, robot.measure())
        robot.advance(step.command)
    return controller, robot, step


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_cost_and_limits_equal_those_of_the_oracle(name):
    rng, (oracle_problem, tick) = np.random.default_rng(0), setting(name)
    tick = replace(tick, past=rng.normal(size=(20, 2)))
    problem = casadi_problem(oracle_problem.config, load_model(name).with_extra_dead_time(EXTRA))
    ahead = oracle_problem.turning_points(tick, tick.feed_forward)
    program, _ = nonlinear_program(oracle_problem, tick, ahead)
    oracle, horizon = ca.Function("oracle", [program["x"]], [program["f"], program["g"]]), problem.horizon
    plan = tick.feed_forward + 0.3 * rng.normal(size=tick.feed_forward.shape)
    inputs = {
        "state": tick.state,
        "pose": tick.pose,
        "slip": tick.slip.flat,
        "sent": tick.past[-horizon.size2_in("sent") :].T,
        "late": tick.late,
        "last_command": tick.last_command,
        "reference": np.column_stack([tick.aim, tick.heading]).T,
        "feed_forward": np.vstack([tick.fed_before, tick.feed_forward]).T,
        "ahead": ahead[None],
        "direction": np.ones((2, oracle_problem.steps)),
    }
    outputs = {key: value.full() for key, value in horizon(plan=plan.T, **inputs).items()}
    cost, rows = (value.full().ravel() for value in oracle(np.append(plan, np.zeros(10 * oracle_problem.steps))))
    assert outputs["cost"].item() == pytest.approx(cost.item(), rel=1e-12)
    n = 2 * oracle_problem.steps
    assert outputs["hard"][2:].T.ravel() == pytest.approx(rows[:n], abs=1e-12)
    assert outputs["soft"].T.ravel() == pytest.approx(rows[n:], abs=1e-12)


@pytest.mark.parametrize(("overrides", "model"), [({}, None), (CURVED, None), ({}, saturating())])
def test_casadi_problem_gives_the_compiled_plan_without_effect_on_the_next_tick(overrides, model):
    config = load_config("ssm", {"horizon": 15} | overrides)
    (controller, robot, step), (second, *_) = (drive(config, model) for _ in range(2))
    problem, inputs = casadi_problem(config, model), controller.problem_inputs()
    plan_inputs = {name: inputs[name] for name in problem.horizon.name_in()[1:]}
    outputs = problem.horizon(plan=step.planned_commands.T, **plan_inputs)
    assert pytest.approx(step.plan, abs=1e-12) == outputs["poses"].full().T
    program = controller.quadratic_program()
    assert np.abs(controller.quadratic_program(step.planned_commands + 0.1).q - program.q).max() > 1e-6
    measurement = robot.measure()
    commands = [driver.step(robot.time, measurement).planned_commands for driver in (controller, second)]
    assert (commands[0] == commands[1]).all()


def test_commands_change_direction_before_the_body_at_a_cusp():
    controller, robot, path = Controller(load_config("ssm")), make_plant("model:ssm", seed=1), load_trajectory("k_turn")
    robot.reset(path.sample([0.0]).pose[0])
    controller.start(path, robot.time)
    directions = np.ones((2, 30))
    while directions[0, -1] == 1.0 and robot.time < path.duration:
        robot.advance(controller.step(robot.time, robot.measure()).command)
        directions = controller.problem_inputs()["direction"]
    (body,), (command,) = (np.flatnonzero(np.diff(row)) for row in directions)
    assert (np.abs(directions) == 1.0).all() and 0 <= command < body


def test_commands_of_a_drive_equal_ipopts_commands_after_the_start():
    """The product iterates once per tick."""
    controller, reference = Controller(load_config("ssm", {"horizon": 12})), load_trajectory("s")
    plant = make_plant("model:ssm", sensors="default", seed=1)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    for k in range(round(reference.duration / plant.sample_time) - 100):
        step = controller.step(plant.time, plant.measure())
        if k >= 100 and k % 60 == 40:
            assert step.planned_commands[0] == pytest.approx(solve_with_ipopt(controller)[0], abs=2e-3)
        plant.advance(step.command)


def test_linearisation_has_the_gradient_of_the_nonlinear_cost():
    controller, _, step = drive(load_config("ssm", {"horizon": 15}))
    plan = step.planned_commands + 0.05 * np.random.default_rng(1).normal(size=(15, 2))
    program, problem = controller.quadratic_program(plan), casadi_problem(controller.config)
    inputs = controller.problem_inputs()
    values = {name: inputs[name] for name in problem.horizon.name_in()[1:]}
    symbol = ca.SX.sym("plan", 2, 15)
    gradient = ca.gradient(problem.horizon(symbol, *values.values())[0], ca.vec(symbol))
    expected = ca.Function("gradient", [symbol], [gradient])(plan.T).full().ravel()
    assert (program.P @ np.append(plan, np.zeros(150)) + program.q)[:30] == pytest.approx(expected, abs=1e-9)


def test_reprs_contain_sizes_without_arrays():
    controller, _, step = drive(load_config("ssm", {"horizon": 5}), ticks=5)
    assert repr(controller.quadratic_program()).startswith("QuadraticProgram of 60 variables, 95 rows: ")
    assert "nlp" not in repr(casadi_problem(controller.config))
    assert "_planned" not in repr(step) and "estimate=Estimate at 0.0808 s: " in repr(step)


def test_missing_plan_and_short_plan_raise_error():
    controller = Controller("ssm")
    controller.start(load_trajectory("circle"), 0.0)
    controller.step(0.0, Measurement())
    with pytest.raises(RuntimeError, match="call step until its mode is TRACKING"):
        controller.problem_inputs()
    with pytest.raises(ValueError, match="plan: 3 pairs; give one for each of the 30 steps"):
        drive(load_config("ssm", {"horizon": 30}), ticks=5)[0].quadratic_program(np.zeros((3, 2)))
