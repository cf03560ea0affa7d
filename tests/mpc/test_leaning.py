"""What leaning on limits proves to be the solution is the solution."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.qp.backend import Task
from diffdrive_mpc.mpc.qp.condensed_solver import CondensedSolver
from diffdrive_mpc.mpc.qp.leaning import lean_on
from diffdrive_mpc.mpc.qp.limit_rows import HARD_KINDS, KINDS
from hypothesis import given, settings
from hypothesis import strategies as st
from test_qp_backends import BACKENDS, STEPS, WEIGHTS, random_problem, solver_settings

HARD = tuple(range(HARD_KINDS))


class Rows:
    """A least-distance problem by its numbers."""

    def __init__(self, rows, lower, upper):
        self.rows, self.lower, self.upper = np.array(rows, dtype=float), np.array(lower), np.array(upper)


def solved_by_daqp(qp):
    task = Task(qp, qp.relax(), HARD, np.zeros(2 * STEPS), np.zeros((KINDS, STEPS)))
    return task, BACKENDS["daqp"](STEPS, solver_settings(), WEIGHTS).solve(task)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.2, 2.0))
def test_the_right_limits_are_the_solution_at_once(seed, tightness):
    task, answer = solved_by_daqp(random_problem(seed, tightness))
    problem = task.qp.least_distance(task.relaxed, HARD)
    found = lean_on(problem, answer.multipliers[:HARD_KINDS].ravel(), 1e-6)
    assert found is not None and found.rounds == 1
    assert problem.found(found.z, found.pressing).plan == pytest.approx(answer.plan, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000), st.floats(0.2, 2.0), st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=24, max_size=24)
)
def test_whatever_it_begins_from_it_ends_at_the_solution_or_says_that_it_does_not(seed, tightness, near):
    task, answer = solved_by_daqp(random_problem(seed, tightness))
    problem = task.qp.least_distance(task.relaxed, HARD)
    found = lean_on(problem, np.array(near), 1e-6)
    if found is not None:
        assert problem.found(found.z, found.pressing).plan == pytest.approx(answer.plan, abs=1e-5)


def test_limits_that_contradict_each_other_or_are_no_numbers_prove_nothing():
    assert lean_on(Rows([[1.0, 0.0], [1.0, 0.0]], [2.0, -9.0], [9.0, 1.0]), np.array([-1.0, 1.0]), 1e-6) is None
    assert lean_on(Rows([[np.nan, 0.0]], [-1.0], [1.0]), np.array([1.0]), 1e-6) is None


def test_osqp_is_not_asked_where_the_last_limits_still_press(monkeypatch):
    qp = random_problem(3, 1.0)
    qp.soft_lower[:], qp.soft_upper[:] = -1e3, 1e3
    solver = CondensedSolver(STEPS, solver_settings("osqp", tolerance=1e-9), WEIGHTS)
    first = solver.solve(qp, np.zeros((STEPS, 2)))
    asked = []
    monkeypatch.setattr(solver._backend, "solve", asked.append)
    solver._multipliers = np.roll(solver._multipliers, 1, axis=1)  # the solver takes them to be one step ahead by now
    solver._multipliers[:, 0] = 0.0
    again = solver.solve(qp, np.zeros((STEPS, 2)))
    assert asked == []
    assert again.plan == pytest.approx(first.plan, abs=1e-6)
