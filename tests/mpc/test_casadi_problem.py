"""The nonlinear problem in CasADi: against the oracle's, against the compiled plan, and its inputs."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from nonlinear_program import saturating
from test_oracle_problem import EXTRA, setting

from diffdrive_mpc import (
    Controller,
    Measurement,
    casadi_problem,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
)
from oracle.nonlinear import nonlinear_program

CURVED = {"estimator.crab": 0.02, "estimator.veer": 0.05, "estimator.track_growth": 0.1}


def driven(config, model=None, ticks=155):
    controller, robot, square = Controller(config, model), make_plant("model:ssm", seed=1), load_trajectory("square")
    robot.reset(square.sample([0.0]).pose[0])
    controller.start(square, robot.time)
    for _ in range(ticks):
        step = controller.step(robot.time, robot.measure())
        robot.advance(step.command)
    return controller, robot, step


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_cost_and_limits_equal_those_of_the_oracle(name):
    rng, (subject, tick) = np.random.default_rng(0), setting(name)
    tick = replace(tick, past=rng.normal(size=(20, 2)))
    problem = casadi_problem(subject.config, load_model(name).with_extra_dead_time(EXTRA))
    ahead = subject.turning_points(tick, tick.feed_forward)
    program, _ = nonlinear_program(subject, tick, ahead)
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
        "direction": np.ones((2, subject.steps)),
    }
    outputs = {key: value.full() for key, value in horizon(plan=plan.T, **inputs).items()}
    cost, rows = (value.full().ravel() for value in oracle(np.append(plan, np.zeros(10 * subject.steps))))
    assert outputs["cost"].item() == pytest.approx(cost.item(), rel=1e-12)
    n = 2 * subject.steps
    assert outputs["hard"][2:].T.ravel() == pytest.approx(rows[:n], abs=1e-12)
    assert outputs["soft"].T.ravel() == pytest.approx(rows[n:], abs=1e-12)


@pytest.mark.parametrize(("overrides", "model"), [({}, None), (CURVED, None), ({}, saturating())])
def test_it_repeats_the_compiled_plan_and_leaves_the_next_tick_alone(overrides, model):
    config = load_config("ssm", {"horizon": 15} | overrides)
    (controller, robot, step), (twin, *_) = (driven(config, model) for _ in range(2))
    problem, inputs = casadi_problem(config, model), controller.problem_inputs()
    named = {name: inputs[name] for name in problem.horizon.name_in()[1:]}
    outputs = problem.horizon(plan=step.planned_commands.T, **named)
    assert pytest.approx(step.plan, abs=1e-12) == outputs["poses"].full().T
    before = controller.quadratic_program()
    assert np.abs(controller.quadratic_program(step.planned_commands + 0.1).q - before.q).max() > 1e-6
    measurement = robot.measure()
    commands = [each.step(robot.time, measurement).planned_commands for each in (controller, twin)]
    assert (commands[0] == commands[1]).all()


def test_a_linearisation_has_the_gradient_of_the_nonlinear_cost():
    controller, _, step = driven(load_config("ssm", {"horizon": 15}))
    plan = step.planned_commands + 0.05 * np.random.default_rng(1).normal(size=(15, 2))
    program, problem = controller.quadratic_program(plan), casadi_problem(controller.config)
    inputs = controller.problem_inputs()
    values = {name: inputs[name] for name in problem.horizon.name_in()[1:]}
    symbol = ca.SX.sym("plan", 2, 15)
    gradient = ca.gradient(problem.horizon(symbol, *values.values())[0], ca.vec(symbol))
    expected = ca.Function("gradient", [symbol], [gradient])(plan.T).full().ravel()
    assert (program.P @ np.append(plan, np.zeros(150)) + program.q)[:30] == pytest.approx(expected, abs=1e-9)


def test_a_tick_without_a_plan_and_a_short_plan_are_refused():
    controller = Controller("ssm")
    controller.start(load_trajectory("circle"), 0.0)
    controller.step(0.0, Measurement())
    with pytest.raises(RuntimeError, match="call step until its mode is TRACKING"):
        controller.problem_inputs()
    with pytest.raises(ValueError, match="plan: 3 pairs; give one for each of the 30 steps"):
        driven(load_config("ssm", {"horizon": 30}), ticks=5)[0].quadratic_program(np.zeros((3, 2)))
