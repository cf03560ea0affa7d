"""The oracle: its problem against IPOPT on the nonlinear program, and its feed-forward."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from diffdrive_mpc import load_config, load_model
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.nonlinear import nonlinear_program
from oracle.problem import TrackingProblem
from oracle.solver import solve
from oracle.tick import FeedForward, Tick

DT = 0.0202
EXTRA = (0.011, 0.033)
SLIP = Slip(
    v_offset=0.01, omega_gain=1.05, longitudinal_gain=0.98, yaw_gain=0.9, side_slip=0.1,
    turn_ahead=0.04, turn_left=-0.03, slide_x=0.02, slide_y=-0.03,
)  # fmt: skip


def problem(model_name, horizon, **overrides):
    model = load_model(model_name).with_extra_dead_time(EXTRA).discretise(DT)
    # With lower weights the iterations converge slowly for a robot at rest.
    weights = {"weights.v_increment": 20.0, "weights.omega_increment": 15.0}
    return TrackingProblem(load_config("ssm", {"horizon": horizon} | weights | overrides), model)


def setting(model_name, horizon=15, **overrides):
    """Return the problem and the tick of a robot next to a curve, at speed."""
    tracking_problem = problem(model_name, horizon, **overrides)
    # With a corridor, the robot drives outwards, so that the limit is active.
    heading = -0.3 if "limits.corridor" in overrides else 0.06
    theta = 0.5 * DT * np.arange(horizon + 1)
    aim = np.column_stack([np.sin(theta), 1 - np.cos(theta), theta])
    past, steps = np.tile([0.45, 0.4], (tracking_problem.model.memory + 3, 1)), np.arange(horizon)
    return tracking_problem, Tick(
        pose=np.array([0.02, -0.03, heading]),
        state=tracking_problem.model.settled_state([0.45, 0.4]),
        slip=SLIP,
        past=past,
        last_command=past[-1],
        aim=aim,
        heading=aim[:, 2] + 0.05,
        feed_forward=np.column_stack([0.5 - 0.001 * steps, 0.47 + 0.002 * steps]),
        fed_before=np.array([0.505, 0.465]),
        late=np.array([0.4, 1.3]),
    )


def converge(subject, tick, iterations=30):
    """Return the fixed point of real-time iterations of a robot at rest."""
    plan = tick.feed_forward
    for _ in range(iterations):
        previous, solution = plan, solve(subject.quadratic_program(tick, plan))
        plan = solution.x.reshape(-1, 2)
        if np.abs(plan - previous).max() < 1e-8:
            return plan, solution
    raise AssertionError("the iteration does not converge")


def ipopt(subject, tick, ahead=None):
    program, bounds = nonlinear_program(subject, tick, ahead)
    options = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    solver = ca.nlpsol("reference", "ipopt", program, options)
    start = np.concatenate([tick.feed_forward.ravel(), np.zeros(10 * subject.steps)])
    solution = np.array(solver(x0=start, **bounds)["x"]).ravel()
    assert solver.stats()["success"]
    return solution[: 2 * subject.steps].reshape(-1, 2)


def test_fixed_turning_points_of_the_guess_increase_the_cost_slightly():
    """The iteration converges to the optimum for fixed turning points, which is close to the true optimum."""
    subject, tick = setting("ssm")
    tick = replace(tick, slip=replace(tick.slip, load_shift=0.05))
    plan, _ = converge(subject, tick)
    ahead = subject.turning_points(tick, plan)
    assert np.ptp(ahead) > 0.004
    assert plan == pytest.approx(ipopt(subject, tick, ahead), abs=2e-6)
    cost, optimum = nonlinear_cost(subject, tick, None), ipopt(subject, tick)
    assert cost(optimum.ravel()) <= cost(plan.ravel()) < 1.02 * cost(optimum.ravel())


def nonlinear_cost(subject, tick, ahead):
    """Return the cost of a plan without slacks, as a function of the flat plan."""
    program, _ = nonlinear_program(subject, tick, ahead)
    cost = ca.Function("cost", [program["x"]], [program["f"]])
    slack = np.zeros(10 * subject.steps)
    return lambda plan: float(cost(np.concatenate([plan, slack])))


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_feed_forward_holds_a_constant_twist_against_slip(name):
    model = load_model(name)
    slip = Slip(v_offset=0.03, omega_gain=0.9, longitudinal_gain=0.97, yaw_gain=0.8, turn_left=0.05)
    feed_forward = FeedForward(model, DT, 10, 0)
    commands = feed_forward.commands(np.tile([0.6, 0.4], (feed_forward.samples, 1)), slip, np.zeros(2))
    wheels = commands @ model.dc_gain.T * [1.0, 0.9] + [0.03, 0.0]
    v, omega = (wheels * [0.97, 0.8]).T
    assert np.column_stack([v + 0.05 * omega, omega]) == pytest.approx(np.tile([0.6, 0.4], (11, 1)))


def test_feed_forward_leads_by_one_lag_and_the_delay():
    model = load_model("ssm")
    feed_forward = FeedForward(model, DT, 10, 3)
    ramp = np.outer(np.arange(feed_forward.samples) * DT, [1.0, 1.0])
    twist = feed_forward.commands(ramp, Slip(), np.array([1.5, 2.0])) @ model.dc_gain.T
    expected = np.arange(-1, 10)[:, None] * DT + model.lag + DT * np.array([1.5, 2.0])
    assert twist == pytest.approx(expected, abs=1e-9)
