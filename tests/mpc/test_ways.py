"""The condensed and the sparse way have one solution: they share nothing but the arcs and the constants."""

from dataclasses import replace

import numpy as np
import pytest
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.sparse.solver import SparseSolver
from diffdrive_mpc.mpc.tick import Tick
from diffdrive_mpc.mpc.ways import CondensedWay, make_way
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot, drive

from diffdrive_mpc.models import load_model
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.estimation.slip import Slip
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.solver.report import SolverStatus

DT, STEPS = 0.0202, 12
TIGHT = {"solver.tolerance": 1e-8, "solver.max_iterations": 100_000}
LIMITS = {
    "wide": {"limits.corridor": 5.0, "limits.v_slew": 20.0, "limits.omega_slew": 60.0},
    "hard": {"limits.v": 0.5, "limits.omega": 0.6, "limits.v_slew": 0.5, "limits.omega_slew": 2.0},
    "soft": {"limits.predicted_omega": 0.5, "limits.corridor": 0.04},
}


def problem(model, limits, **overrides):
    config = load_config("ssm", {"horizon": STEPS} | TIGHT | LIMITS[limits] | overrides)
    sampled = load_model(model).with_extra_dead_time((0.011, 0.033)).discretise(DT)
    return TrackingProblem(config, sampled)


def random_tick(subject, seed):
    """A robot somewhere near a curve of random speed, curvature and slip, moving somehow, and a plan for it."""
    rng = np.random.default_rng(seed)
    v, omega = rng.uniform(0.1, 0.6), rng.uniform(-0.8, 0.8)
    theta = rng.uniform(-3, 3) + omega * DT * np.arange(STEPS + 1)
    move = v * DT * np.column_stack([np.cos(theta), np.sin(theta)])
    reference = np.column_stack([np.cumsum(move, axis=0), theta])
    slip = Slip(*(rng.normal(size=5) * [0.02, 0.05, 0.03, 0.1, 0.05] + [0, 1, 1, 1, 0]))
    commands = np.array([v, omega]) + 0.05 * rng.normal(size=(subject.model.memory, 2))
    state = subject.model.settled_state(commands.mean(axis=0))
    free = subject.prediction.free_twists(state, commands).reshape(-1, 2)
    tick = Tick(
        pose=reference[0] + rng.normal(size=3) * [0.03, 0.03, 0.1],
        free_twist=slip.gains * (free + slip.offset),
        gains=slip.gains,
        side_slip=slip.side_slip,
        reference=reference,
        heading=reference[:, 2] + slip.side_slip * omega,
        feed_forward=np.tile([v, omega], (STEPS, 1)),
        last_command=np.clip(commands[-1], [-0.5, -0.6], [0.5, 0.6]),
    )
    return tick, tick.feed_forward + 0.1 * rng.normal(size=(STEPS, 2))


def both(model, limits, seed):
    condensed, sparse = problem(model, limits, **{"solver.backend": "daqp"}), problem(model, limits)
    tick, plan = random_tick(condensed, seed)
    first = CondensedWay(condensed, Condenser(condensed)).solve(tick, plan)
    second = SparseSolver(sparse).solve(tick, plan)
    assert first.report.status is second.report.status is SolverStatus.SOLVED
    return first, second


@pytest.mark.parametrize("limits", ["wide", "hard"])
@settings(max_examples=20, deadline=None)
@given(st.sampled_from(["ssm", "sm", "mbm"]), st.integers(0, 10_000))
def test_both_ways_have_one_solution(limits, model, seed):
    condensed, sparse = both(model, limits, seed)
    assert sparse.plan == pytest.approx(condensed.plan, abs=1e-6)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_both_ways_have_one_solution_with_soft_limits(seed):
    condensed, sparse = both("ssm", "soft", seed)
    # Operator splitting converges slowly along a soft limit: 1e-8 on its residuals is less on the commands.
    assert sparse.plan == pytest.approx(condensed.plan, abs=5e-6)
    assert sparse.report.soft_limits == condensed.report.soft_limits


def test_the_limits_matter_in_those_problems():
    active, soft = [], []
    for seed in range(20):
        hard, _ = both("ssm", "hard", seed)
        active.append(hard.report.iterations > 0)
        loose, _ = both("ssm", "soft", seed)
        soft.append(loose.report.soft_limits)
    assert np.mean(active) > 0.5
    assert np.mean(soft) > 0.3


def test_the_sparse_way_reports_data_that_are_not_finite():
    subject = problem("ssm", "hard")
    tick, plan = random_tick(subject, 0)
    for spoilt in (replace(tick, pose=tick.pose * np.nan), replace(tick, last_command=np.array([1e40, 0.0]))):
        assert SparseSolver(subject).solve(spoilt, plan).report.status is SolverStatus.NOT_FINITE


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [({}, CondensedWay), ({"solver.backend": "daqp"}, CondensedWay), ({"solver.formulation": "sparse"}, SparseSolver)],
)
def test_the_configuration_chooses_the_way(chosen, expected):
    subject = problem("ssm", "hard", **chosen)
    assert isinstance(make_way(subject, Condenser(subject)), expected)


@pytest.mark.parametrize("limits", ["hard", "soft"])
@pytest.mark.parametrize(
    "chosen", [{}, {"solver.backend": "daqp"}, {"solver.formulation": "sparse"}, {"solver.compiled": "never"}]
)
def test_a_drive_repeats_bit_for_bit_with_a_new_controller_and_with_a_reset_one(chosen, limits):
    reference, model = load_trajectory("s"), load_model("ssm")
    config = load_config("ssm", {"horizon": 10} | LIMITS[limits] | chosen)
    first, second = Controller(config), Controller(config)
    commands = []
    for controller in (first, second, first):
        controller.reset()
        robot = IdealRobot(model.discretise(config.sample_time), reference.sample([0.0]).pose[0], noise=1.0)
        results, _, _ = drive(controller, robot, reference, 2.0)
        commands.append([result.command for result in results])
        assert any(result.solver.iterations for result in results), "limits must matter"
    assert (np.array(commands[0]) == np.array(commands[1])).all()
    assert (np.array(commands[0]) == np.array(commands[2])).all()


def test_a_backend_that_cannot_solve_the_formulation_is_refused_with_the_remedy():
    with pytest.raises(ConfigError, match="set backend: osqp or formulation: condensed"):
        load_config("ssm", {"solver.formulation": "sparse", "solver.backend": "daqp"})
