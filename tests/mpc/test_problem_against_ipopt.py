"""The condensed problem and its solver against IPOPT on the nonlinear program, and against finite differences."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.qp.condensed_solver import CondensedSolver
from diffdrive_mpc.mpc.tick import Tick
from diffdrive_mpc.mpc.ways import make_way

from diffdrive_mpc.models import load_model
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.estimation.slip import Slip
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.solver.report import SolverStatus

DT = 0.0202
EXTRA = (0.011, 0.033)

SOFT = {
    "none": {},
    "twist": {"limits.predicted_v": 0.46, "limits.predicted_omega": 0.5},
    "wheels": {"limits.wheel_speed": 0.55},
    "corridor": {"limits.corridor": 0.031},
}


def setting(model_name, horizon=15, **overrides):
    config = load_config(
        "ssm", {"horizon": horizon, "solver.tolerance": 1e-8, "solver.max_iterations": 50000} | overrides
    )
    model = load_model(model_name).with_extra_dead_time(EXTRA).discretise(DT)
    problem = TrackingProblem(config, model)
    state = model.settled_state([0.45, 0.4])
    past = np.tile([0.45, 0.4], (model.memory, 1))
    # Driving outwards where the corridor is to matter.
    heading = -0.3 if "limits.corridor" in overrides else 0.06
    theta = 0.5 * DT * np.arange(horizon + 1)
    reference = np.column_stack([np.sin(theta), 1 - np.cos(theta), theta])
    slip = Slip(v_offset=0.01, omega_gain=1.05, longitudinal_gain=0.98, yaw_gain=0.9, side_slip=0.1)
    free = problem.prediction.free_twists(state, past).reshape(-1, 2)
    tick = Tick(
        pose=np.array([0.02, -0.03, heading]),
        free_twist=slip.gains * (free + slip.offset),
        gains=slip.gains,
        side_slip=slip.side_slip,
        reference=reference,
        heading=reference[:, 2] + 0.05,
        feed_forward=np.tile([0.5, 0.47], (horizon, 1)),
        last_command=past[-1],
    )
    return problem, tick


WAYS = {
    "condensed/osqp": {},
    "condensed/daqp": {"solver.backend": "daqp"},
    "sparse/osqp": {"solver.formulation": "sparse"},
}


def converge(problem, tick, iterations=30):
    way = make_way(problem, Condenser(problem))
    plan = tick.feed_forward
    for _ in range(iterations):
        before, solution = plan, way.solve(tick, plan)
        assert solution.report.status is SolverStatus.SOLVED
        plan = solution.plan
        if np.abs(plan - before).max() < 1e-7:
            break
    return plan, solution.report


def ipopt(problem, tick):
    program, bounds = problem.nonlinear_program(tick)
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    solver = ca.nlpsol("reference", "ipopt", program, options)
    start = np.concatenate([tick.feed_forward.ravel(), np.zeros(10 * problem.steps)])
    solution = np.array(solver(x0=start, **bounds)["x"]).ravel()
    assert solver.stats()["success"]
    return solution[: 2 * problem.steps].reshape(-1, 2)


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize(
    ("model_name", "way"),
    [("ssm", way) for way in WAYS] + [("sm", "condensed/osqp"), ("mbm", "condensed/daqp"), ("mbm", "sparse/osqp")],
)
def test_real_time_iterations_converge_to_ipopts_solution(model_name, way, soft):
    problem, tick = setting(model_name, **SOFT[soft] | WAYS[way])
    plan, report = converge(problem, tick)
    assert report.soft_limits == (soft != "none"), "the case must exercise what it is named for"
    assert plan == pytest.approx(ipopt(problem, tick), abs=2e-5)


def test_the_default_tolerance_is_accurate_enough_for_the_robot():
    problem, tick = setting("ssm", 30, **{"solver.tolerance": load_config("ssm").solver.tolerance})
    plan, _ = converge(problem, tick)
    assert plan[0] == pytest.approx(ipopt(problem, tick)[0], abs=1e-4)


def nonlinear_cost(problem, tick):
    """The cost of a plan without slacks, as a function of the flat plan."""
    program, _ = problem.nonlinear_program(tick)
    cost = ca.Function("cost", [program["x"]], [program["f"]])
    slack = np.zeros(10 * problem.steps)
    return lambda plan: float(cost(np.concatenate([plan, slack])))


@pytest.mark.parametrize("seed", range(4))
def test_gradient_agrees_with_finite_differences_of_the_cost(seed):
    problem, tick = setting("ssm")
    plan = tick.feed_forward + 0.2 * np.random.default_rng(seed).normal(size=tick.feed_forward.shape)
    qp = Condenser(problem).condense(tick, plan)
    cost, flat, step = nonlinear_cost(problem, tick), plan.ravel(), 1e-5
    numeric = [(cost(flat + step * e) - cost(flat - step * e)) / (2 * step) for e in np.eye(len(flat))]
    assert qp.H @ flat + qp.g == pytest.approx(np.array(numeric), abs=1e-5)


def test_hessian_is_symmetric_and_positive_definite():
    problem, tick = setting("ssm")
    H = Condenser(problem).condense(tick, tick.feed_forward).H
    assert pytest.approx(H.T, abs=1e-9) == H
    assert np.linalg.eigvalsh(H).min() > 0


def test_soft_rows_are_the_gradients_of_what_they_limit():
    problem, tick = setting("ssm")
    condenser, plan, step = Condenser(problem), tick.feed_forward, 1e-6
    qp = condenser.condense(tick, plan)
    soft = qp.soft.copy()

    def across(flat):
        error = condenser.poses(tick, flat.reshape(-1, 2))[1:] - tick.reference[1:]
        c, s = np.cos(tick.reference[1:, 2]), np.sin(tick.reference[1:, 2])
        return c * error[:, 1] - s * error[:, 0]

    flat = plan.ravel()
    numeric = np.column_stack([(across(flat + step * e) - across(flat - step * e)) / (2 * step) for e in np.eye(30)])
    assert soft[4] == pytest.approx(numeric, abs=1e-8)
    limit = problem.soft_limits(tick)[4]
    assert limit - qp.soft_upper[4] == pytest.approx(across(flat) - soft[4] @ flat, abs=1e-12)


def test_hard_limits_hold_in_the_plan():
    problem, tick = setting("ssm", **{"limits.v": 0.4, "limits.omega_slew": 0.5})
    plan, _ = converge(problem, tick)
    increments = np.diff(np.vstack([tick.last_command, plan]), axis=0)
    # The limit of 0.4 lies below the last command of 0.45: it is approached at the slew limit, then kept.
    assert plan[0, 0] <= 0.45 - 2.0 * DT + 1e-6
    assert plan[2:, 0].max() <= 0.4 + 1e-6
    assert np.abs(increments[:, 1]).max() <= 0.5 * DT + 1e-6


def test_a_horizon_shorter_than_the_dead_time_is_refused():
    config = load_config("ssm", {"horizon": 2})
    with pytest.raises(ValueError, match="set horizon to"):
        TrackingProblem(config, load_model("ssm").with_extra_dead_time([0.1, 0.1]).discretise(DT))


def test_data_that_are_not_finite_are_reported_not_solved():
    problem, tick = setting("ssm")
    qp = Condenser(problem).condense(tick, np.full((15, 2), np.nan))
    solver = CondensedSolver(15, problem.config.solver, problem.config.weights)
    status = solver.solve(qp, tick.feed_forward).report.status
    assert status is SolverStatus.NOT_FINITE
    assert not status.usable


def test_the_iteration_limit_is_reported_and_not_usable():
    problem, tick = setting("ssm", **SOFT["twist"] | {"solver.max_iterations": 10})
    solver = CondensedSolver(15, problem.config.solver, problem.config.weights)
    report = solver.solve(Condenser(problem).condense(tick, tick.feed_forward), tick.feed_forward).report
    assert report.status is SolverStatus.MAX_ITERATIONS
    assert not report.status.usable


def shifted(problem, tick, ticks):
    """The same problem some ticks later: the reference moves on, the rest stays."""
    reference = tick.reference + ticks * np.array([0.5 * DT, 0.0, 0.0])
    return replace(tick, pose=tick.pose + [0.5 * DT * ticks, 0.0, 0.0], reference=reference)


@pytest.mark.parametrize("backend", ["osqp", "daqp"])
@pytest.mark.parametrize("limit", [SOFT["twist"], {"limits.v_slew": 0.2}])
def test_a_warm_start_needs_fewer_iterations_than_a_cold_one(backend, limit):
    problem, tick = setting("ssm", **limit | {"solver.tolerance": 1e-5, "solver.backend": backend})
    plan, _ = converge(problem, tick)
    condenser, config = Condenser(problem), problem.config
    warm, cold = (CondensedSolver(problem.steps, config.solver, config.weights) for _ in range(2))
    for _ in range(3):
        warm.solve(condenser.condense(tick, plan), plan)
    after = condenser.condense(shifted(problem, tick, 1), plan)
    assert 0 < warm.solve(after, plan).report.iterations < cold.solve(after, 0 * plan).report.iterations


def test_a_reset_solver_is_as_new():
    problem, tick = setting("ssm", **SOFT["twist"])
    config, qp = problem.config, Condenser(problem).condense(tick, tick.feed_forward)
    used, new = (CondensedSolver(problem.steps, config.solver, config.weights) for _ in range(2))
    for _ in range(3):
        used.solve(qp, tick.feed_forward)
    used.reset()
    again, first = used.solve(qp, tick.feed_forward), new.solve(qp, tick.feed_forward)
    assert (again.plan == first.plan).all()
    assert again.report == first.report


def test_data_too_large_to_be_real_are_refused():
    problem, tick = setting("ssm")
    far = replace(tick, last_command=np.array([1e40, 0.0]))
    qp = Condenser(problem).condense(far, tick.feed_forward)
    solver = CondensedSolver(problem.steps, problem.config.solver, problem.config.weights)
    assert solver.solve(qp, tick.feed_forward).report.status is SolverStatus.NOT_FINITE
