"""Peers solve the controller's own problem: stage by stage it has the same predictions, cost, limits and solution."""

from dataclasses import asdict

import casadi as ca
import numpy as np
import pytest
from diffdrive_mpc.mpc.tick import Tick
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.bench.studies.speed.stage import stage_data, stage_problem
from diffdrive_mpc.bench.studies.speed.subjects.nlp_peer import NlpPeer
from diffdrive_mpc.models import integrate_pose, load_model
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.estimation.slip import Slip
from diffdrive_mpc.mpc.problem import TrackingProblem

DT = 0.0202
SLIP = Slip(v_offset=0.02, omega_gain=1.04, longitudinal_gain=0.97, yaw_gain=0.85, side_slip=0.08)
SOFT = {
    "none": {},
    "twist": {"limits.predicted_v": 0.46, "limits.predicted_omega": 0.5},
    "wheels": {"limits.wheel_speed": 0.55},
    "corridor": {"limits.corridor": 0.031},
}


def setting(name, horizon, overrides=None, seed=0):
    """A problem, one tick of it, and the same for peers."""
    random = np.random.default_rng(seed)
    config = load_config("ssm", {"horizon": horizon, **(overrides or {})})
    model = load_model(name).with_extra_dead_time((0.011, 0.033)).discretise(DT)
    problem = TrackingProblem(config, model)
    state = model.settled_state([0.45, 0.4])
    past = np.array([0.45, 0.4]) + 0.01 * random.standard_normal((model.memory, 2))
    theta = 0.5 * DT * np.arange(horizon + 1)
    reference = np.column_stack([np.sin(theta), 1 - np.cos(theta), theta])
    free = problem.prediction.free_twists(state, past).reshape(-1, 2)
    tick = Tick(
        pose=np.array([0.02, -0.03, -0.3 if "limits.corridor" in (overrides or {}) else 0.06]),
        free_twist=SLIP.gains * (free + SLIP.offset),
        gains=SLIP.gains,
        side_slip=SLIP.side_slip,
        reference=reference,
        heading=theta + 0.05,
        feed_forward=np.array([0.5, 0.47]) + 0.02 * random.standard_normal((horizon, 2)),
        last_command=past[-1],
    )
    return problem, tick, stage_problem(config, model), stage_data(problem, tick, state, SLIP.offset, past)


def functions(stages):
    return [ca.Function.deserialize(getattr(stages, name)) for name in ("step", "tracking", "effort", "soft_values")]


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_stages_lead_to_the_predicted_twists_and_poses(name, seed):
    problem, tick, stages, (z, parameters) = setting(name, 8, seed=seed)
    plan = np.random.default_rng(seed).uniform(-1, 1, (8, 2))
    twist = tick.free_twist + tick.gains * (problem.prediction.from_plan @ plan.ravel()).reshape(-1, 2)
    step, *_, soft_values = functions(stages)
    n, pose = problem.model.order, tick.pose
    for k, u in enumerate(plan):
        z = np.array(step(z, u, parameters[k])).ravel()
        v, omega = (twist[k] + twist[k + 1]) / 2
        pose = integrate_pose(pose, v, omega, DT, tick.side_slip)
        np.testing.assert_allclose(z[n : n + 3], pose, atol=1e-12)
        np.testing.assert_allclose(z[-2:], u)
        values = np.array(soft_values(z, parameters[k + 1])).ravel()
        np.testing.assert_allclose(values[:4], problem.twist_rows(tick.gains) @ twist[k + 1], atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_the_cost_of_any_plan_is_that_of_the_controllers_problem(seed):
    problem, tick, stages, (z, parameters) = setting("sm", 6, SOFT["wheels"], seed)
    plan = np.random.default_rng(seed).uniform(-1, 1, (6, 2))
    step, tracking, effort, soft_values = functions(stages)
    cost = 0.0
    for k, u in enumerate(plan):
        cost += stages.effort_weights @ np.array(effort(z, u, parameters[k])).ravel() ** 2 / 2
        z = np.array(step(z, u, parameters[k])).ravel()
        error = np.array(tracking(z, parameters[k + 1])).ravel()
        cost += (stages.terminal if k == 5 else 1.0) * stages.tracking_weights @ error**2 / 2
        over = np.maximum(np.abs(np.array(soft_values(z, parameters[k + 1])).ravel()) - parameters[k + 1, 11:], 0)
        cost += stages.soft * over.sum() + stages.soft_quadratic * (over**2).sum() / 2
    program, bounds = problem.nonlinear_program(tick)
    evaluate = ca.Function("program", [program["x"]], [program["f"], program["g"]])
    soft_rows = slice(12, None)
    g = np.array(evaluate(np.concatenate([plan.ravel(), np.zeros(60)]))[1]).ravel()[soft_rows]
    over = np.maximum(g - bounds["ubg"][soft_rows], 0)
    under = np.maximum(bounds["lbg"][soft_rows] - g, 0)
    expected = float(evaluate(np.concatenate([plan.ravel(), over, under]))[0])
    assert cost == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize("name", ["ssm", "mbm"])
@pytest.mark.parametrize(
    ("plugin", "options"),
    [
        ("ipopt", {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}),
        ("fatrop", {"fatrop.print_level": 0, "fatrop.tol": 1e-9}),
    ],
)
def test_a_peers_solution_is_that_of_the_controllers_problem(plugin, options, name, soft):
    problem, tick, stages, data = setting(name, 12, SOFT[soft])
    program, bounds = problem.nonlinear_program(tick)
    reference = ca.nlpsol(
        "reference", "ipopt", program, {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    )
    start = np.concatenate([tick.feed_forward.ravel(), np.zeros(120)])
    expected = np.array(reference(x0=start, **bounds)["x"]).ravel()[:2]
    assert reference.stats()["success"]
    peer = NlpPeer(asdict(stages), {"plugin": plugin, "options": options}, None)
    peer.reset(*data)
    command = peer.solve(*data)
    assert peer.report().solved
    np.testing.assert_allclose(command, expected, atol=1e-5)


def test_a_last_command_that_is_not_on_its_way_is_refused():
    problem, tick, _, _ = setting("ssm", 5)
    past = np.zeros((problem.model.memory, 2))
    with pytest.raises(ValueError, match="last command"):
        stage_data(problem, tick, np.zeros(problem.model.order), np.zeros(2), past)
