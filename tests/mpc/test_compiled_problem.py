"""The problem in C is the Python one: ticks, programs, minimisers, limits, and the references that are tracked."""

import re
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from diffdrive_mpc.mpc.begin_tick import begin_tick
from diffdrive_mpc.mpc.compiled.condenser import CompiledCondenser
from diffdrive_mpc.mpc.compiled.constants import initialiser, sizes_header, tracking_constants, tracking_sizes
from diffdrive_mpc.mpc.compiled.reference import CompiledReference, compile_reference
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.feed_forward import FeedForward
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.models import load_model
from diffdrive_mpc.mpc import load_config, load_trajectory
from diffdrive_mpc.mpc.estimation.estimate import Estimate
from diffdrive_mpc.mpc.problem import TrackingProblem
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.trajectories.moved import starting_at

# Horizons that fill whole lanes, and that do not; the shortest that MBM's dead time allows.
HORIZONS = (4, 9, 16)
SAME = {"rel": 1e-9, "abs": 1e-9}
FIELDS = ("H", "g", "box", "slew", "last_command", "soft", "soft_lower", "soft_upper")


@cache
def parts(name, steps):
    config = load_config(name).model_copy(update={"horizon": steps})
    model = load_model(name).with_extra_dead_time([0.013, 0.027])
    problem = TrackingProblem(config, model.discretise(config.sample_time))
    feed_forward = FeedForward(model, config.sample_time, steps)
    return problem, feed_forward, Condenser(problem), CompiledCondenser(problem, feed_forward)


@cache
def trajectory(name):
    return load_trajectory(name)


def random_situation(problem, feed_forward, seed, reference, time):
    """An estimate anywhere near a reference, commands on their way, and a plan."""
    rng, n = np.random.default_rng(seed), problem.model.order
    sample = trajectory(reference).sample(time + np.arange(feed_forward.samples) * problem.model.dt)
    values = rng.normal(size=2 * n + 28)
    values[2 : 2 + n] = 0.5 * rng.normal(size=n)
    values[2 + n : 7 + n] = [0.03, 1.0, 1.0, 0.8, 0.05] * rng.uniform(0.3, 1.5, size=5)
    values[n + 8 : n + 11] = (
        sample.pose[0] + rng.normal(size=3) * [0.2, 0.2, 0.3] + [0, 0, 2 * np.pi * rng.integers(-2, 3)]
    )
    past = rng.normal(size=(problem.model.memory, 2))
    return Estimate(values, n), past, rng.normal(size=2), sample, rng.normal(size=(problem.steps, 2)) * [0.6, 0.9]


situations = st.tuples(
    st.sampled_from(["ssm", "sm", "mbm"]),
    st.sampled_from(HORIZONS),
    st.integers(0, 10**6),
    st.sampled_from(["circle", "square", "s", "cane"]),
    st.floats(-1.0, 30.0),
)


@settings(max_examples=30)
@given(situations)
def test_ticks_programs_and_their_solutions(situation):
    name, steps, seed, reference, time = situation
    problem, feed_forward, python, compiled = parts(name, steps)
    *given_, plan = random_situation(problem, feed_forward, seed, reference, time)
    tick, same_tick = begin_tick(problem, feed_forward, *given_), compiled.begin(*given_)
    for field in fields(tick):
        assert getattr(same_tick, field.name) == pytest.approx(getattr(tick, field.name), **SAME), field.name
    assert compiled.poses(same_tick, plan) == pytest.approx(python.poses(tick, plan), **SAME)

    qp, same = python.condense(tick, plan), compiled.condense(same_tick, plan)
    scale = np.abs(qp.H).max()
    for field in FIELDS:
        tolerance = {"abs": 1e-12 * scale, "rel": 1e-9} if field in ("H", "g") else SAME
        assert getattr(same, field) == pytest.approx(getattr(qp, field), **tolerance), field
    assert (same.H == same.H.T).all()
    flat = plan.ravel()
    assert same.soft_values(flat) == pytest.approx(qp.soft_values(flat), **SAME)
    assert same.soft_rows(4) == pytest.approx(qp.soft_rows(4), **SAME)
    for slack in (0.0, 0.3):
        assert same.broken(flat, slack) == qp.broken(flat, slack)
        assert same.broken(0.01 * flat, slack) == qp.broken(0.01 * flat, slack)

    relaxed, found = qp.relax(), same.relax()
    assert found.plan == pytest.approx(relaxed.plan, **SAME)
    assert found.factor == pytest.approx(relaxed.factor, **SAME)
    assert found.factor @ found.factor.T == pytest.approx(same.H, rel=1e-12, abs=1e-12 * scale)
    assert found.residual < 1e-10 * scale


def test_a_tick_made_elsewhere_is_condensed_too():
    problem, feed_forward, python, compiled = parts("sm", 16)
    *given_, plan = random_situation(problem, feed_forward, 1, "circle", 3.0)
    tick = begin_tick(problem, feed_forward, *given_)
    assert compiled.condense(tick, plan).g == pytest.approx(python.condense(tick, plan).g, **SAME)


@pytest.mark.parametrize(("spoiled", "status"), [(np.nan, SolverStatus.NOT_FINITE), (1e17, SolverStatus.NOT_FINITE)])
def test_data_that_are_no_robots_are_refused(spoiled, status):
    problem, feed_forward, python, compiled = parts("ssm", 16)
    *given_, plan = random_situation(problem, feed_forward, 2, "circle", 3.0)
    tick = begin_tick(problem, feed_forward, *given_)
    wrong = replace(tick, feed_forward=np.full_like(tick.feed_forward, spoiled))
    assert python.condense(wrong, plan).relax() is status
    assert compiled.condense(wrong, plan).relax() is status
    assert compiled.condense(tick, np.full_like(plan, np.nan)).relax() is SolverStatus.NOT_FINITE


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
@given(times=st.lists(st.floats(-5, 80) | st.just(float("nan")), min_size=1, max_size=20))
@settings(max_examples=20)
def test_references_are_sampled_alike(name, times):
    reference = trajectory(name)
    moved = starting_at(reference, [1.0, -2.0, 0.7])
    for python in (reference, moved):
        compiled = compile_reference(python)
        assert (compiled.name, compiled.duration) == (python.name, python.duration)
        for mine, theirs in zip(compiled.sample(times), python.sample(times), strict=True):
            assert mine == pytest.approx(theirs, abs=1e-12, rel=1e-12, nan_ok=True)


def test_splines_are_sampled_alike(tmp_path):
    path = tmp_path / "curve.yaml"
    path.write_text("waypoints: [[0, 0], [1, 0.2], [1.5, 1.0], [0.5, 1.5]]\n")
    python = load_trajectory(str(path))
    compiled = compile_reference(python)
    assert isinstance(compiled, CompiledReference)
    times = np.linspace(-1, python.duration + 1, 700)
    for part in (times, times[::5]):
        for mine, theirs in zip(compiled.sample(part), python.sample(part), strict=True):
            assert mine == pytest.approx(theirs, abs=1e-12)


def test_a_reference_of_another_kind_stays_as_it_is():
    class Standing:
        name, duration = "standing", 1.0

    standing = Standing()
    assert compile_reference(standing) is standing


def test_constants_as_text_are_those_in_memory():
    problem, feed_forward, *_ = parts("mbm", 9)
    constants = tracking_constants(problem, feed_forward)
    text = initialiser(constants)
    assert [float(number) for number in re.findall(r"R\(([^)]*)\)", text)] == np.concatenate(
        [values.ravel() for values in constants.values()]
    ).tolist()
    header = sizes_header(tracking_sizes(problem.model, 9, feed_forward))
    assert "#define DDMPC_STEPS 9\n" in header
