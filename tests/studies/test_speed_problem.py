"""Peers solve the controller's problem: every stage has the same predictions, cost, limits and solution."""

from dataclasses import asdict
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc import Controller, load_config, load_model, load_trajectory, make_plant
from oracle.nonlinear import nonlinear_program
from oracle.problem import TrackingProblem
from oracle.tick import Tick
from studies.speed.stage import stage_data, stage_problem
from studies.speed.subjects.nlp_peer import NlpPeer

pytestmark = pytest.mark.system

SOFT = {
    "none": {},
    "twist": {"limits.predicted_v": 0.46, "limits.predicted_omega": 0.45},
    "wheels": {"limits.wheel_speed": 0.55},
    # A high weight of the heading moves the plan to the limit of the corridor.
    "corridor": {
        **{"limits.corridor": 0.030, "weights.along": 150.0, "weights.across": 500.0},
        **{"weights.heading": 28.0, "weights.v": 20.0, "weights.omega": 2.0},
    },
}
KINDS = {"none": set(), "twist": {0, 1}, "wheels": {2, 3}, "corridor": {4}}
"""Kinds of soft limit that each case exercises, in the order of the problem."""


def setting(name, horizon, soft="none", seed=0):
    """Return a tick of a simulated drive: the controller's step, the oracle's problem, and the data for peers."""
    # Re-entry would replace the reference, and a stage has no learned delay.
    calm = {"horizon": horizon, "reentry.enabled": False, "compensation.delay": False, "weights.v_increment": 20.0}
    config = load_config("ssm", calm | SOFT[soft])
    model = load_model(name).with_extra_dead_time((0.011, 0.033))
    sampled, controller = model.discretise(config.sample_time), Controller(config, model)
    plant, reference = make_plant("model:ssm", seed=seed), load_trajectory("circle")
    # For the corridor the robot heads outwards, and the tick is before its return.
    turn, ticks = (-0.8, 13) if soft == "corridor" else (0.0, 60 + seed % 40)
    plant.reset(reference.sample([0.0]).pose[0] + [0.0, 0.0, turn])
    controller.start(reference, plant.time)
    sent = [np.zeros(2)] * sampled.memory
    for _ in range(ticks):
        result = controller.step(plant.time, plant.measure())
        plant.advance(result.command)
        sent.append(result.command)
    # Exclude the command that the last tick decided.
    past = np.array(sent[-1 - sampled.memory : -1])
    return SimpleNamespace(
        controller=controller,
        result=result,
        past=past,
        problem=TrackingProblem(config, sampled),
        tick=oracle_tick(controller.program, result.estimate, past),
        stages=stage_problem(config, sampled),
        data=stage_data(controller.program, result.estimate, past),
        ahead=controller.program.ahead.copy(),
    )


def active_limits(case, plan):
    """Return the kinds of soft limit that `plan` (N, 2) reaches."""
    _, values = case.problem.outcome(case.tick, plan[:, :, None], case.ahead)
    limits = case.problem.soft_limits(values[:, 0, 0])
    return set(np.flatnonzero(np.abs(values[:, 1:, 0]).max(axis=1) > limits - 1e-6).tolist())


def functions(stages):
    return [ca.Function.deserialize(getattr(stages, name)) for name in ("step", "tracking", "effort", "soft_values")]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_cost_of_any_plan_equals_that_of_the_controllers_problem(seed):
    case = setting("sm", 6, "wheels", seed)
    z, parameters = case.data
    stages, plan = case.stages, np.random.default_rng(seed).uniform(-1, 1, (6, 2))
    step, tracking, effort, soft_values = functions(stages)
    cost = 0.0
    for k, u in enumerate(plan):
        cost += stages.effort_weights @ np.array(effort(z, u, parameters[k])).ravel() ** 2 / 2
        z = np.array(step(z, u, parameters[k])).ravel()
        error = np.array(tracking(z, parameters[k + 1])).ravel()
        cost += (stages.terminal if k == 5 else 1.0) * stages.tracking_weights @ error**2 / 2
        over = np.maximum(np.abs(np.array(soft_values(z, parameters[k + 1])).ravel()) - parameters[k + 1, 17:], 0)
        cost += stages.soft * over.sum() + stages.soft_quadratic * (over**2).sum() / 2
    program, bounds = nonlinear_program(case.problem, case.tick, case.ahead)
    evaluate = ca.Function("program", [program["x"]], [program["f"], program["g"]])
    # Skip the rows of the increments.
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
def test_peer_solution_equals_that_of_the_controllers_problem(plugin, options, name, soft):
    case = setting(name, 12, soft)
    program, bounds = nonlinear_program(case.problem, case.tick, case.ahead)
    reference = ca.nlpsol(
        "reference", "ipopt", program, {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    )
    start = np.concatenate([case.tick.feed_forward.ravel(), np.zeros(120)])
    solution = np.array(reference(x0=start, **bounds)["x"]).ravel()
    assert reference.stats()["success"]
    assert active_limits(case, solution[:24].reshape(-1, 2)) <= KINDS[soft], "no other limit may be active"
    assert bool(active_limits(case, solution[:24].reshape(-1, 2))) == (soft != "none"), "limits must be active"
    peer = NlpPeer(asdict(case.stages), {"plugin": plugin, "options": options}, None)
    peer.reset(*case.data)
    command = peer.solve(*case.data)
    assert peer.report().solved
    np.testing.assert_allclose(command, solution[:2], atol=1e-5)


# A tick of a real drive, as data for the oracle and for peers.


def oracle_tick(program, estimate, past):
    """Return the oracle's tick, as a copy, for `program` and `estimate`; `past` (memory, 2) are delayed commands."""
    return Tick(
        pose=estimate.pose.copy(),
        state=estimate.state.copy(),
        slip=estimate.slip,
        past=past.copy(),
        last_command=program.last_command.copy(),
        aim=program.aim[:, :3].copy(),
        heading=program.aim[:, 3].copy(),
        feed_forward=program.feed_forward.copy(),
        fed_before=program.fed_before.copy(),
        late=program.late.copy(),
    )
