"""The least-distance problem in C against the one in Python, and both against the quadratic program."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.compiled.condenser import CompiledCondenser
from diffdrive_mpc.mpc.condensed import Condenser
from diffdrive_mpc.mpc.feed_forward import FeedForward
from diffdrive_mpc.mpc.qp.limit_rows import KINDS
from hypothesis import given, settings
from hypothesis import strategies as st
from test_ways import DT, problem, random_tick

from diffdrive_mpc.models import load_model


def programs(seed, model="ssm"):
    """The same quadratic program from Python and from C, each with its minimiser."""
    subject = problem(model, "hard")
    tick, plan = random_tick(subject, seed)
    velocity = load_model(model).with_extra_dead_time((0.011, 0.033))
    compiled = CompiledCondenser(subject, FeedForward(velocity, DT, subject.steps))
    found = [condenser.condense(tick, plan) for condenser in (Condenser(subject), compiled)]
    # C keeps its memory as long as the condenser lives.
    return [(qp, qp.relax()) for qp in found], compiled


kinds_of_limits = st.sets(st.integers(0, KINDS - 1), min_size=1).map(lambda kinds: tuple(sorted(kinds)))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), kinds_of_limits)
def test_c_and_python_give_the_same_numbers(seed, kinds):
    both, _alive = programs(seed)
    mine, theirs = (qp.least_distance(relaxed, kinds) for qp, relaxed in both)
    for name in ("rows", "lower", "upper"):
        assert getattr(theirs, name) == pytest.approx(getattr(mine, name), abs=1e-9)
    rng = np.random.default_rng(seed)
    z, pressing = (
        rng.normal(size=mine.rows.shape[1]),
        rng.normal(size=len(mine.rows)) * rng.integers(0, 2, len(mine.rows)),
    )
    for found, expected in zip(theirs.found(z, pressing), mine.found(z, pressing), strict=True):
        assert found == pytest.approx(expected, abs=1e-9)
    multipliers = mine.found(z, pressing).multipliers
    assert (theirs.flags(multipliers, 0.5) == mine.flags(multipliers, 0.5)).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_the_distance_is_the_cost_and_rows_are_the_limits(seed, compiled):
    both, _alive = programs(seed)
    qp, relaxed = both[compiled]
    rng = np.random.default_rng(seed)
    z = rng.normal(size=len(qp.g))
    lean = qp.least_distance(relaxed, tuple(range(KINDS)))
    plan, excess, *_ = lean.found(z, np.zeros(len(lean.rows)))

    def cost(u):
        return u @ qp.H @ u / 2 + qp.g @ u

    assert cost(plan) - cost(relaxed.plan) == pytest.approx(z @ z / 2, rel=1e-9)
    increments = np.diff(plan.reshape(-1, 2), axis=0, prepend=qp.last_command[None])
    worst = max((np.abs(plan) - qp.box).max(), (np.abs(increments) - qp.slew).max())
    assert excess == pytest.approx(max(worst, 0.0), abs=1e-9)
    room = (lean.upper - lean.rows @ z).reshape(KINDS, -1)
    assert room[4:] == pytest.approx(qp.soft_upper - qp.soft_values(plan), abs=1e-9)
