"""The oracle's solver against the optimality conditions, which do not care how a solution was found."""

from dataclasses import replace

import numpy as np
import osqp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from oracle.problem import QuadraticProgram
from oracle.solver import optimality, solve

STEPS = 6


def random_program(seed, tightness=0.5):
    """A strictly convex problem of which about `tightness` of the limits matter."""
    rng, n = np.random.default_rng(seed), 2 * STEPS
    root, last = rng.normal(size=(n, n)), rng.uniform(-0.2, 0.2, 2)
    box, slew = (np.tile(rng.uniform(0.2, 0.4, 2) / tightness, STEPS) for _ in range(2))
    first = np.concatenate([last, np.zeros(n - 2)])
    middle, width = rng.normal(scale=0.3, size=5 * STEPS), rng.uniform(0.5, 2.0, 5 * STEPS) / tightness
    return QuadraticProgram(
        H=root @ root.T + 5 * np.eye(n),
        g=rng.normal(scale=12.0, size=n),
        rows=np.vstack([np.eye(n), np.eye(n) - np.eye(n, k=-2)]),
        lower=np.concatenate([-box, first - slew]),
        upper=np.concatenate([box, first + slew]),
        soft_rows=rng.normal(size=(5 * STEPS, n)),
        soft_lower=middle - width,
        soft_upper=middle + width,
        # Cheap enough that some soft limits are exceeded, dear enough that others are kept.
        price=3.0,
        quadratic=20.0,
    )


def by_osqp(qp):
    """The solution with slack variables, upwards and downwards, by operator splitting."""
    n, soft = len(qp.g), len(qp.soft_lower)
    unit, none = sparse.identity(soft), np.full(soft, np.inf)
    P = sparse.block_diag([sparse.csc_matrix(qp.H), qp.quadratic * unit, qp.quadratic * unit])
    A = sparse.bmat([[qp.rows, None, None], [qp.soft_rows, -unit, unit], [None, unit, None], [None, None, unit]])
    lower = np.concatenate([qp.lower, qp.soft_lower, 0 * none[:0], np.zeros(2 * soft)])
    upper = np.concatenate([qp.upper, qp.soft_upper, none, none])
    solver = osqp.OSQP()
    q = np.concatenate([qp.g, np.full(2 * soft, qp.price)])
    settings_ = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200_000, "verbose": False}
    solver.setup(sparse.csc_matrix(sparse.triu(P)), q, sparse.csc_matrix(A), lower, upper, **settings_)
    result = solver.solve(raise_error=False)
    return result.x[:n] if result.info.status_val == osqp.SolverStatus.OSQP_SOLVED else None


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.floats(0.02, 2.0))
def test_its_answer_satisfies_the_optimality_conditions(seed, tightness):
    qp = random_program(seed, tightness)
    answer = solve(qp)
    x, force = answer.x, answer.hard @ qp.rows + answer.soft @ qp.soft_rows
    assert qp.H @ x + qp.g + force == pytest.approx(np.zeros(len(x)), abs=1e-9)
    values, soft = qp.rows @ x, qp.soft_rows @ x
    assert (values <= qp.upper + 1e-9).all() and (values >= qp.lower - 1e-9).all()
    # Only a limit that is reached presses, and towards the inside.
    assert values[answer.hard > 1e-9] == pytest.approx(qp.upper[answer.hard > 1e-9], abs=1e-9)
    assert values[answer.hard < -1e-9] == pytest.approx(qp.lower[answer.hard < -1e-9], abs=1e-9)
    # A soft limit presses with up to its price while it is kept, and with what its excess costs where it is not.
    excess = np.maximum(np.maximum(soft - qp.soft_upper, qp.soft_lower - soft), 0)
    size = np.abs(answer.soft)
    assert (size <= qp.price + qp.quadratic * excess + 1e-8).all()
    assert size[excess > 1e-8] == pytest.approx((qp.price + qp.quadratic * excess)[excess > 1e-8], abs=1e-7)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_operator_splitting_agrees(seed):
    qp = random_program(seed)
    expected = by_osqp(qp)
    if expected is not None:
        assert solve(qp).x == pytest.approx(expected, abs=1e-6)


def test_the_random_problems_have_limits_of_all_sorts():
    """Else the conditions above would hold of problems without limits only."""
    found = [(qp, solve(qp)) for qp in map(random_program, range(30))]
    hard = np.array([np.abs(answer.hard).reshape(2, -1).max(axis=1) > 0 for _, answer in found])
    soft = np.array([np.abs(answer.soft).reshape(5, -1).max(axis=1) > 0 for _, answer in found])
    assert (hard.mean(axis=0) > 0.1).all() and (soft.mean(axis=0) > 0.1).all()
    exceeded = [np.maximum(qp.soft_rows @ a.x - qp.soft_upper, qp.soft_lower - qp.soft_rows @ a.x) for qp, a in found]
    assert 0.2 < np.mean([(part > 1e-6).any() for part in exceeded]) < 1.0


@given(st.integers(0, 1000))
@settings(max_examples=30)
def test_what_is_not_the_solution_has_no_certificate(seed):
    qp = random_program(seed)
    answer, rng = solve(qp), np.random.default_rng(seed)
    assert optimality(qp, answer) < 1e-9
    assert optimality(qp, replace(answer, x=answer.x + 1e-5 * rng.normal(size=len(answer.x)))) > 1e-7
    for name in ("hard", "soft"):
        multipliers = getattr(answer, name)
        spoilt = multipliers + 1e-2 * rng.normal(size=len(multipliers)) * (multipliers != 0)
        if multipliers.any():
            assert optimality(qp, replace(answer, **{name: spoilt})) > 1e-7


def test_where_no_limit_matters_it_is_the_minimiser():
    qp = random_program(3, tightness=1e-3)
    assert solve(qp).x == pytest.approx(np.linalg.solve(qp.H, -qp.g), abs=1e-12)
