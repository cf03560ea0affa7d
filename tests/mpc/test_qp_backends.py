"""Solutions of the condensed problem against its optimality conditions, which do not care how they were found."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.condensed import CondensedProgram
from diffdrive_mpc.mpc.qp.backend import Task
from diffdrive_mpc.mpc.qp.condensed_solver import CondensedSolver
from diffdrive_mpc.mpc.qp.daqp_backend import DaqpBackend
from diffdrive_mpc.mpc.qp.least_distance import ArrayLeastDistance
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS, KINDS, LimitRows
from diffdrive_mpc.mpc.qp.osqp_backend import OsqpBackend
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.solver.report import SolverStatus

STEPS = 6
# Cheap enough that some soft limits are exceeded, dear enough that others are kept.
WEIGHTS = load_config("ssm", {"weights.soft": 3.0, "weights.soft_quadratic": 20.0}).weights
BACKENDS = {"osqp": OsqpBackend, "daqp": DaqpBackend}


def solver_settings(backend="daqp", **changes):
    return load_config(
        "ssm", {f"solver.{key}": value for key, value in {"backend": backend, "tolerance": 1e-8, **changes}.items()}
    ).solver


def random_problem(seed, tightness=0.5, softness=1.0):
    """A strictly convex problem of which about `tightness` of the limits matter."""
    rng = np.random.default_rng(seed)
    n = 2 * STEPS
    root = rng.normal(size=(n, n))
    last = rng.uniform(-0.2, 0.2, 2)
    middle = rng.normal(scale=0.3, size=(5, STEPS))
    width = rng.uniform(0.5, 2.0, (5, STEPS)) / tightness
    return CondensedProgram(
        H=root @ root.T + 5 * np.eye(n),
        g=rng.normal(scale=12.0, size=n),
        box=np.repeat(rng.uniform(0.2, 0.4, 2)[None] / tightness, STEPS, axis=0).ravel(),
        slew=rng.uniform(0.2, 0.4, 2) / tightness,
        last_command=last,
        soft=softness * rng.normal(size=(5, STEPS, n)),
        soft_lower=middle - width,
        soft_upper=middle + width,
    )


def gradients(qp):
    """(9, N, 2 N) gradients of all limit rows, by finite differences of their values."""
    rows = LimitRows(STEPS)
    rows.load(qp)
    at_zero = rows.values(np.zeros(2 * STEPS))
    return np.stack([rows.values(e) - at_zero for e in np.eye(2 * STEPS)], axis=-1)


def whole_task(qp, multipliers):
    """All kinds of limit at once."""
    return Task(qp, qp.relax(), tuple(range(KINDS)), np.zeros(2 * STEPS), multipliers)


def answer(qp, backend):
    chosen = BACKENDS[backend](STEPS, solver_settings(backend, max_iterations=100_000), WEIGHTS)
    rows = LimitRows(STEPS)
    rows.load(qp)
    return chosen.solve(whole_task(qp, np.zeros((KINDS, STEPS)))), rows


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.2, 2.0))
def test_daqps_answer_satisfies_the_optimality_conditions(seed, tightness):
    qp = random_problem(seed, tightness)
    found, rows = answer(qp, "daqp")
    assert found.report.status is SolverStatus.SOLVED
    pressing = found.multipliers
    force = np.einsum("ks,ksu->u", pressing, gradients(qp))
    assert qp.H @ found.plan + qp.g + force == pytest.approx(np.zeros(2 * STEPS), abs=1e-7)
    values = rows.values(found.plan)
    over, under = values - rows.upper, rows.lower - values
    hard, soft = slice(0, HARD_KINDS), slice(HARD_KINDS, KINDS)
    assert np.maximum(over, under)[hard].max() <= 1e-7
    # Only a limit that is reached presses, and towards the inside.
    assert over[pressing > 1e-9] == pytest.approx(np.maximum(over[pressing > 1e-9], 0), abs=1e-7)
    assert under[pressing < -1e-9] == pytest.approx(np.maximum(under[pressing < -1e-9], 0), abs=1e-7)
    # A soft limit presses with up to its price while it is kept, and with what its excess costs where it is not.
    excess = np.maximum(np.maximum(over, under)[soft], 0)
    exceeded = excess > 1e-7
    size = np.abs(pressing[soft])
    assert (size <= WEIGHTS.soft + WEIGHTS.soft_quadratic * excess + 1e-6).all()
    assert size[exceeded] == pytest.approx(WEIGHTS.soft + WEIGHTS.soft_quadratic * excess[exceeded], abs=1e-5)


def test_the_random_problems_have_limits_of_all_sorts():
    """Else the conditions above would hold of problems without limits only."""
    found = [answer(random_problem(seed), "daqp") for seed in range(40)]
    pressing = np.array([np.abs(a.multipliers).max(axis=1) > 0 for a, _ in found])
    assert (pressing.mean(axis=0) > 0.1).all()
    exceeded = [(np.maximum(r.values(a.plan) - r.upper, r.lower - r.values(a.plan))[4:] > 1e-6).any() for a, r in found]
    assert 0.2 < np.mean(exceeded) < 1.0


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_the_backends_agree(seed):
    qp = random_problem(seed)
    (by_daqp, _), (by_osqp, _) = answer(qp, "daqp"), answer(qp, "osqp")
    assume(by_osqp.report.status is SolverStatus.SOLVED)
    assert by_osqp.plan == pytest.approx(by_daqp.plan, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.02, 0.6))
def test_adding_limits_as_they_are_broken_gives_the_solution_with_all_of_them(backend, seed, tightness):
    qp = random_problem(seed, tightness, softness=0.3)
    whole, _ = answer(qp, "daqp")
    solver = CondensedSolver(STEPS, solver_settings(backend, max_iterations=100_000), WEIGHTS)
    solution = solver.solve(qp, np.zeros((STEPS, 2)))
    assert solution.report.status is SolverStatus.SOLVED
    assert solution.plan.ravel() == pytest.approx(whole.plan, abs=1e-5)
    # Warm, it is the same.
    assert solver.solve(qp, solution.plan).plan.ravel() == pytest.approx(whole.plan, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_where_no_limit_matters_the_minimiser_is_exact_without_an_iteration(backend):
    qp = random_problem(3, tightness=1e-3)
    solution = CondensedSolver(STEPS, solver_settings(backend), WEIGHTS).solve(qp, np.zeros((STEPS, 2)))
    assert solution.report.status is SolverStatus.SOLVED
    assert solution.report.iterations == 0
    assert solution.report.dual_residual < 1e-12
    assert solution.plan.ravel() == pytest.approx(np.linalg.solve(qp.H, -qp.g), abs=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_problem_without_a_solution_is_reported(backend):
    qp = random_problem(1)
    far = CondensedProgram(qp.H, qp.g, qp.box, qp.slew, np.array([50.0, 0.0]), qp.soft, qp.soft_lower, qp.soft_upper)
    report = CondensedSolver(STEPS, solver_settings(backend), WEIGHTS).solve(far, np.zeros((STEPS, 2))).report
    assert report.status is SolverStatus.INFEASIBLE
    assert not report.status.usable


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_iteration_limit_is_kept(backend):
    qp = random_problem(5, tightness=2.0)
    limited = solver_settings(backend, max_iterations=10, check_every=1)
    report = CondensedSolver(STEPS, limited, WEIGHTS).solve(qp, np.zeros((STEPS, 2))).report
    assert report.status is SolverStatus.MAX_ITERATIONS
    assert 0 < report.iterations <= 10
    assert not report.status.usable


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("field", ["H", "g", "box", "last_command", "soft_upper"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e40])
def test_numbers_that_are_none_are_refused(backend, field, value):
    qp = random_problem(1)
    spoilt = getattr(qp, field).copy()
    spoilt.reshape(-1)[0] = value
    data = {name: getattr(qp, name) for name in CondensedProgram.__dataclass_fields__} | {field: spoilt}
    solver = CondensedSolver(STEPS, solver_settings(backend), WEIGHTS)
    status = solver.solve(CondensedProgram(**data), np.zeros((STEPS, 2))).report.status
    assert status is SolverStatus.NOT_FINITE


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_cost_that_is_not_convex_is_reported(backend):
    qp = random_problem(1)
    saddle = CondensedProgram(-qp.H, qp.g, qp.box, qp.slew, qp.last_command, qp.soft, qp.soft_lower, qp.soft_upper)
    status = CondensedSolver(STEPS, solver_settings(backend), WEIGHTS).solve(saddle, np.zeros((STEPS, 2))).report.status
    assert status is SolverStatus.NOT_CONVEX


@pytest.mark.parametrize("before", [0, 1])
def test_rows_that_daqp_refuses_are_reported_and_do_no_lasting_harm(monkeypatch, before):
    qp = random_problem(2)
    right, _ = answer(qp, "daqp")
    backend = DaqpBackend(STEPS, solver_settings(), WEIGHTS)
    task = whole_task(qp, np.zeros((KINDS, STEPS)))
    for _ in range(before):
        backend.solve(task)
    with monkeypatch.context() as crossed:
        crossed.setattr(ArrayLeastDistance, "flags", cross_bounds(ArrayLeastDistance.flags))
        assert backend.solve(task).report.status is SolverStatus.INFEASIBLE
    assert backend.solve(task).plan == pytest.approx(right.plan, abs=1e-9)


def cross_bounds(flags):
    def crossing(self, multipliers, price):
        self.lower = self.upper + 1.0
        return flags(self, multipliers, price)

    return crossing


def test_multipliers_that_cannot_be_are_no_harm_to_daqp():
    """A warm start with every limit active, more than there are commands, is put aside."""
    qp = random_problem(2)
    right, _ = answer(qp, "daqp")
    backend = DaqpBackend(STEPS, solver_settings(), WEIGHTS)
    task = whole_task(qp, np.ones((KINDS, STEPS)))
    assert backend.solve(task).plan == pytest.approx(right.plan, abs=1e-9)
