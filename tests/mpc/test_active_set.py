"""The active-set method in C (`mpc/core/active_set.c`) against optimality conditions and DAQP."""

import subprocess
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import cffi
import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

CORE = Path(__file__).parents[2] / "mpc" / "core"
SOURCES = [str(CORE / name) for name in ("active_set.c", "active_rows.c")]
PROVEN, UNFINISHED, NOT_PROVEN, INFEASIBLE = range(4)

DENSE = """
#include "active_set.h"
typedef struct { int n, m; const real *rows; } dense;
static void values(const void *context, const real *plan, real *values)
{
    const dense *all = context;
    for (int i = 0; i < all->m; i++) {
        values[i] = 0;
        for (int k = 0; k < all->n; k++)
            values[i] += all->rows[i * all->n + k] * plan[k];
    }
}
static void row(const void *context, int row, real *out, int *first, int *last)
{
    const dense *all = context;
    const real *own = all->rows + row * all->n;
    int begin = 0, end = all->n;
    while (begin < end && own[begin] == 0)
        begin++;
    while (end > begin && own[end - 1] == 0)
        end--;
    for (int k = begin; k < end; k++)
        out[k] = own[k];
    *first = begin;
    *last = end;
}
ddmpc_limited_result solve_dense(int n, int m, int hard, const real *factor, const real *minimiser, const real *rows,
                                 const real *lower, const real *upper, const real *numbers, int max_iterations,
                                 int max_active, real *reals, int *ints, real *multipliers, real *plan)
{
    const dense all = {n, m, rows};
    const ddmpc_limited_memory memory = {max_active, reals, ints};
    const ddmpc_limited_problem problem = {
        .inputs = n, .rows = m, .hard = hard, .factor = factor, .minimiser = minimiser, .lower = lower, .upper = upper,
        .price = numbers[0], .slope = numbers[1], .values = values, .row = row, .context = &all,
        .slack = numbers[2], .max_iterations = max_iterations,
        .max_operations = numbers[4] > 0 ? ddmpc_limited_allowance(n, m, max_active) : 1LL << 60,
        .deadline = numbers[3] > 0 ? 1e-9 : INFINITY};
    return ddmpc_solve_limited(&problem, &memory, multipliers, plan);
}
"""
DECLARATIONS = """
typedef {real} real;
typedef struct {{
    int status, iterations, late, active;
    long long operations;
    real primal, dual;
}} ddmpc_limited_result;
long long ddmpc_limited_allowance(int inputs, int rows, int max_active);
long long ddmpc_limited_bound(int inputs, int rows, int max_active);
unsigned long ddmpc_limited_reals(int inputs, int rows, int max_active);
unsigned long ddmpc_limited_ints(int inputs, int rows, int max_active);
ddmpc_limited_result solve_dense(int n, int m, int hard, const real *factor, const real *minimiser, const real *rows,
                                 const real *lower, const real *upper, const real *numbers, int max_iterations,
                                 int max_active, real *reals, int *ints, real *multipliers, real *plan);
"""


@cache
def library(number="double"):
    """Return the C functions and the NumPy type of their floating-point numbers."""
    folder = Path(mkdtemp())
    (folder / "ddmpc_sizes.h").write_text("#define DDMPC_FLOAT\n" if number == "float" else "")
    (folder / "dense.c").write_text(DENSE)
    path = folder / "library.so"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", f"-I{folder}", f"-I{CORE}"]
    subprocess.run(["gcc", *flags, str(folder / "dense.c"), *SOURCES, "-o", str(path), "-lm"], check=True)
    ffi = cffi.FFI()
    ffi.cdef(DECLARATIONS.format(real=number))
    return ffi, ffi.dlopen(str(path)), {"double": np.float64, "float": np.float32}[number]


@dataclass
class Problem:
    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    hard: int
    price: float = 50.0
    slope: float = 50.0


@dataclass
class Solution:
    status: int
    iterations: int
    active: int
    primal: float
    dual: float
    multipliers: np.ndarray
    plan: np.ndarray
    operations: int


def solve(p, warm=None, number="double", slack=1e-6, max_iterations=2000, max_active=None, late=False, bounded=False):
    ffi, functions, dtype = library(number)
    m, n = p.A.shape
    max_active = max_active or n + m
    factor = np.linalg.cholesky(p.H).T if np.isfinite(p.H).all() else p.H
    minimiser = -np.linalg.solve(p.H, p.g) if np.isfinite(p.H).all() else p.g

    def as_c_array(array):
        array = np.ascontiguousarray(array, dtype=dtype)
        return array, ffi.cast("real *", array.ctypes.data)

    inputs = [
        as_c_array(a) for a in (factor, minimiser, p.A, p.lower, p.upper, [p.price, p.slope, slack, late, bounded])
    ]
    # The solver must not read these initial values.
    _reals, at_reals = as_c_array(np.full(functions.ddmpc_limited_reals(n, m, max_active), np.nan))
    ints = np.full(functions.ddmpc_limited_ints(n, m, max_active), 2**30, dtype=np.intc)
    multipliers, at_multipliers = as_c_array(np.zeros(m) if warm is None else warm.copy())
    plan, at_plan = as_c_array(np.zeros(n))
    result = functions.solve_dense(
        n, m, p.hard, *(pointer for _, pointer in inputs), max_iterations, max_active, at_reals,
        ffi.cast("int *", ints.ctypes.data), at_multipliers, at_plan,
    )  # fmt: skip
    return Solution(
        result.status, result.iterations, result.active, result.primal, result.dual,
        multipliers.astype(float), plan.astype(float), result.operations,
    )  # fmt: skip


def excess(p, plan):
    values = p.A @ plan
    return np.maximum(values - p.upper, p.lower - values)


def cost(p, plan):
    violation = np.maximum(excess(p, plan)[p.hard :], 0)
    return plan @ p.H @ plan / 2 + p.g @ plan + (p.price * violation + p.slope * violation**2 / 2).sum()


def assert_optimal(p, solution, tolerance=1e-6):
    """Check all optimality conditions of a convex program."""
    values, multipliers = p.A @ solution.plan, solution.multipliers
    excesses = excess(p, solution.plan)
    # Hard limits are satisfied; rows are active only at their bounds, with the correct sign.
    assert excesses[: p.hard].max(initial=0.0) <= tolerance
    at_upper, at_lower = multipliers > 0, multipliers < 0
    slack = np.zeros(len(multipliers))
    soft = np.arange(len(multipliers)) >= p.hard
    over = soft & (np.abs(multipliers) > p.price)
    slack[over] = (np.abs(multipliers[over]) - p.price) / p.slope
    assert values[at_upper] == pytest.approx((p.upper + slack)[at_upper], abs=tolerance)
    assert values[at_lower] == pytest.approx((p.lower - slack)[at_lower], abs=tolerance)
    # The multiplier of an exceeded soft limit is its marginal cost.
    exceeded = soft & (excesses > tolerance)
    assert np.abs(multipliers[exceeded]) == pytest.approx(
        p.price + p.slope * excesses[exceeded], abs=p.slope * tolerance
    )
    gradient = p.H @ solution.plan + p.g + multipliers @ p.A
    scale = 1 + np.abs(multipliers[:, None] * p.A).max(initial=0.0) + np.abs(p.H).max() * np.abs(solution.plan).max()
    assert np.abs(gradient).max() <= tolerance * scale


def random_problem(rng, n, m, hard_share=0.5, tight=1.0):
    """Return a problem with rows in random directions and a point that satisfies the hard rows."""
    root = rng.normal(size=(n, n))
    H = root @ root.T / n + rng.uniform(0.01, 1) * np.eye(n)
    A = rng.normal(size=(m, n)) * rng.integers(0, 2, (m, n))
    if m > 3:
        A[m // 2] = A[0]
        A[m // 3] = A[0] - A[1]
    middle = A @ rng.normal(size=n)
    width = tight * rng.exponential(size=(2, m))
    return Problem(H, rng.normal(size=n) * 3, A, middle - width[0], middle + width[1], round(hard_share * m),
                   price=float(10 ** rng.uniform(-1, 1.5)), slope=float(10 ** rng.uniform(-1, 2)))  # fmt: skip


def robot_problem(rng, steps, extra=0, tight=1.0):
    """Return bounds on two inputs and their increments, and soft limits on lagging outputs, as in a tick.

    The bounds on u[k], u[k + 1] and their difference are linearly dependent.
    """
    N, n = steps, 2 * steps
    index = np.arange(N)
    lags = rng.uniform(0.5, 0.95, 2)
    responses = [np.tril((1 - lag) * lag ** np.abs(index[:, None] - index)) for lag in lags]
    v, omega = np.zeros((N, n)), np.zeros((N, n))
    v[:, 0::2], omega[:, 1::2] = responses
    omega[:, 0::2] = 0.05 * responses[0]
    heading = np.cumsum(omega, axis=0) * 0.05
    across = np.cumsum(heading * rng.uniform(0.2, 1), axis=0) * 0.05
    progress = np.cumsum(v, axis=0) * 0.05
    unit = np.eye(n)
    difference = unit - np.eye(n, k=-2)
    user_rows = [np.tril(rng.normal(size=(N, N))) @ (v + omega) * 0.1 for _ in range(extra)]
    soft = [v, omega, v + 0.3 * omega, v - 0.3 * omega, across, *user_rows]
    A = np.concatenate([unit[0::2], unit[1::2], difference[0::2], difference[1::2], *soft])
    stack = np.concatenate([10 * progress, 10 * across, 2 * heading])
    H = stack.T @ stack + 0.05 * unit + 0.3 * difference.T @ difference
    target = np.repeat(rng.normal(size=(N // 10 + 1, 2)) * [1.0, 1.5], 10, axis=0)[:N].ravel()
    g = -H @ target + 0.1 * rng.normal(size=n)
    limit = np.repeat([0.8, 1.0, 0.1, 0.15, 0.75, 0.9, 0.7, 0.7, 0.05, *[0.3] * extra], N) * tight
    middle = np.zeros(len(A))
    last = rng.uniform(-0.8, 0.8, 2) * tight
    middle[2 * N], middle[3 * N] = last
    offsets = np.repeat(0.1 * rng.normal(size=5 + extra), N)
    middle[4 * N :] = offsets * tight
    return Problem(H, g, A, middle - limit, middle + limit, 4 * N)


def with_two_sided_limits(p, rng, steps, tight=1.0):
    """Return a robot problem with two-sided ranges and separate limits of acceleration and braking."""
    N, lower, upper = steps, p.lower.copy(), p.upper.copy()
    for channel in (0, 1):
        max_forward, max_reverse = rng.uniform(0.2, 1.0, 2) * tight
        rise, fall = rng.uniform(0.02, 0.3, 2) * tight
        last = rng.uniform(-max_reverse, max_forward)
        # A command that crosses zero accelerates for the rest of the sample; later rows use the signs of a plan.
        min_size = abs(last) - fall if abs(last) > fall else -rise * (1 - abs(last) / fall)
        first = sorted([np.copysign(1, last) * min_size, np.copysign(1, last) * (abs(last) + rise)])
        sign = np.repeat(rng.integers(-1, 2, N // 5 + 1), 5)[: N - 1]
        upper[channel * N : (channel + 1) * N], lower[channel * N : (channel + 1) * N] = max_forward, -max_reverse
        rows = slice((2 + channel) * N, (3 + channel) * N)
        lower[rows] = [first[0], *np.where(sign > 0, -fall, -rise)]
        upper[rows] = [first[1], *np.where(sign < 0, fall, rise)]
    return replace(p, lower=lower, upper=upper)


def residuals(p, solution):
    """Return limit violation, scaled gradient of the Lagrangian, and complementarity gap."""
    plan, force = solution.plan, solution.multipliers
    values, soft = p.A @ plan, np.arange(len(force)) >= p.hard
    over = np.where(soft, np.maximum(np.abs(force) - p.price, 0.0) / p.slope, 0.0)
    primal = np.maximum(np.maximum(values - p.upper, p.lower - values) - over, 0.0).max()
    gradient = p.H @ plan + p.g + force @ p.A
    dual = np.abs(gradient).max() / (1 + np.abs(force[:, None] * p.A).max() + np.abs(p.H).max() * np.abs(plan).max())
    slack = np.where(force > 0, p.upper + over - values, np.where(force < 0, values - p.lower + over, 0.0))
    gap = np.abs(force * slack).sum() / (1 + abs(cost(p, plan)))
    return primal, dual, gap


def two_sided_residuals(seed, steps=30):
    """Solve a program with two-sided limits; return residuals, distance to DAQP's solution and active rows."""
    rng = np.random.default_rng(seed)
    tight = 10 ** rng.uniform(-0.5, 0.3)
    p = with_two_sided_limits(robot_problem(rng, steps, tight=tight), rng, steps, tight)
    solution = solve(p, slack=1e-10)
    assert solution.status == PROVEN
    x, flag, _ = solve_with_daqp(p)
    assert flag > 0
    return *residuals(p, solution), np.abs(solution.plan - x).max(), solution.active


def test_programs_with_two_sided_limits_are_solved_exactly():
    # The multipliers of the last program are so large that their rounding alone would leave a gap of 4e-8.
    rows = np.array([two_sided_residuals(seed) for seed in [*range(40), 1033372]])
    assert (rows[:, :3] < 1e-9).all()
    assert (rows[:, 3] < 1e-7).all()
    assert (rows[:, 4] > 3).mean() > 0.5


def solve_with_daqp(p):
    m = len(p.A)
    model = daqp.Model()
    sense = np.zeros(m, dtype=np.intc)
    sense[p.hard :] = 8
    model.setup(p.H, p.g, p.A, p.upper, p.lower, sense)
    model.soft_weights(np.full(m, 1 / p.slope), np.full(m, 1 / p.slope), np.full(m, p.price), np.full(m, p.price))
    model.settings = {"primal_tol": 1e-9, "iter_limit": 10000}
    x, _, flag, info = model.solve()
    return x, flag, info


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 90), st.floats(0, 1), st.floats(-2, 1))
def test_random_problems_are_solved_optimally(seed, n, m, hard_share, tightness):
    p = random_problem(np.random.default_rng(seed), n, m, hard_share, 10**tightness)
    result = solve(p)
    assert result.status == PROVEN
    assert_optimal(p, result)
    x, flag, _ = solve_with_daqp(p)
    assert flag > 0
    assert cost(p, result.plan) == pytest.approx(cost(p, x), rel=1e-6, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 30), st.integers(0, 3), st.floats(0.4, 1.5))
def test_robot_problems_are_solved_optimally(seed, steps, extra, tight):
    """Linearly dependent bounds and increments, and more soft rows than inputs."""
    p = robot_problem(np.random.default_rng(seed), steps, extra, tight)
    result, (x, flag, _) = solve(p), solve_with_daqp(p)
    if result.status == INFEASIBLE:
        assert flag < 0
        return
    assert result.status == PROVEN
    assert_optimal(p, result)
    assert cost(p, result.plan) == pytest.approx(cost(p, x), rel=1e-6, abs=1e-5)


def constrained_problem(seed, steps=20):
    """Return a problem of a robot with many active rows, and its solution from a cold start."""
    p = robot_problem(np.random.default_rng(seed), steps)
    return p, solve(p)


@pytest.mark.parametrize("seed", range(5))
def test_warm_start_at_the_solution_takes_two_iterations_at_most(seed):
    p, cold = constrained_problem(seed)
    warm = solve(p, cold.multipliers)
    assert cold.active > 10
    assert cold.iterations > 3
    assert warm.iterations <= 2
    assert warm.plan == pytest.approx(cold.plan, abs=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_multipliers_of_a_similar_problem_save_iterations(seed):
    """The gradient of the cost changes slightly, as between two ticks."""
    p, cold = constrained_problem(seed)
    p.g = p.g + 0.002 * np.abs(p.g).max() * np.random.default_rng(seed).normal(size=p.g.shape)
    cold_again, warm = solve(p), solve(p, cold.multipliers)
    assert warm.status == PROVEN
    assert warm.iterations < 0.7 * cold_again.iterations
    assert warm.plan == pytest.approx(cold_again.plan, abs=1e-7)


@pytest.mark.parametrize("factor", [0.1, 1.0, 15.0])
def test_step_of_the_multipliers_ends_at_the_maximum(factor):
    """Each unconstrained command is far beyond its limit: one step finds the multipliers from any start.

    From 15 times the solution, a step of 15/14 would reach zero and release the row.
    """
    p = Problem(np.eye(4), -np.array([3.0, 2.0, -2.0, 5.0]), np.eye(4), -np.ones(4), np.ones(4), hard=2, price=1e3)
    solution = solve(p, factor * np.array([2.0, 1.0, -1.0, 4.0]))
    assert solution.plan == pytest.approx([1.0, 1.0, -1.0, 1.0])
    assert (solution.status, solution.iterations, solution.active) == (PROVEN, 1, 4)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 1e3, np.nan, np.inf]))
def test_wrong_warm_start_does_not_change_the_solution(seed, size):
    rng = np.random.default_rng(seed)
    p = robot_problem(rng, 10)
    result = solve(p, size * rng.normal(size=len(p.A)))
    assert result.status == PROVEN
    assert_optimal(p, result)
    assert result.plan == pytest.approx(solve(p).plan, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_stopped_solve_returns_the_plan_of_its_multipliers_and_can_be_continued(seed):
    p, result = constrained_problem(seed)
    total = result.iterations
    for stopped, limit in [(solve(p, max_iterations=limit), limit) for limit in (1, total - 1)] + [
        (solve(p, late=True), 1)
    ]:
        assert (stopped.status, stopped.iterations) == (UNFINISHED, limit)
        assert stopped.plan == pytest.approx(-np.linalg.solve(p.H, p.g + p.A.T @ stopped.multipliers), abs=1e-7)
        continued = solve(p, stopped.multipliers)
        assert continued.status == PROVEN
        assert continued.plan == pytest.approx(result.plan, abs=1e-6)
    assert solve(p, max_iterations=total).status == PROVEN


def test_operations_stay_below_the_bound_from_any_start():
    """The operation limit stops solves with random warm starts and of infeasible problems."""
    rng = np.random.default_rng(0)
    _, functions, _ = library()
    shares, stopped = [], 0
    for number in range(300):
        steps, tight = int(rng.integers(3, 16)), float(10 ** rng.uniform(-1.5, 0.5))
        p = robot_problem(rng, steps, tight=tight)
        p = with_two_sided_limits(p, rng, steps, tight) if number % 2 else p
        m, n = p.A.shape
        max_active = int(rng.integers(n, n + m))
        start = 10 ** rng.uniform(-3, 3) * rng.normal(size=m) * (rng.random(m) < rng.random())
        result = solve(p, start, max_active=max_active, bounded=True)
        shares.append(result.operations / functions.ddmpc_limited_bound(n, m, max_active))
        stopped += result.status == UNFINISHED and result.operations >= functions.ddmpc_limited_allowance(
            n, m, max_active
        )
        if result.status == PROVEN:
            assert_optimal(p, result)
    assert max(shares) < 1.0
    assert max(shares) > 1 / 3
    assert stopped > 3


def test_active_set_stops_if_rows_exceed_its_capacity():
    p, solution = constrained_problem(0)
    stopped = solve(p, max_active=solution.active - 2)
    assert stopped.status == UNFINISHED
    assert 0 < stopped.active <= solution.active - 2


def test_contradicting_hard_rows_are_reported_as_infeasible():
    p = robot_problem(np.random.default_rng(0), 8)
    # Commands must alternate between two ranges, faster than the limits of their increments permit.
    p.lower[:8], p.upper[:8] = np.where(np.arange(8) % 2, -0.9, 0.7), np.where(np.arange(8) % 2, -0.7, 0.9)
    result = solve(p)
    assert result.status == INFEASIBLE
    assert result.plan == pytest.approx(-np.linalg.solve(p.H, p.g))


@pytest.mark.parametrize(("row", "gap", "status"), [(4, 0.1, INFEASIBLE), (4, 1e-6, NOT_PROVEN), (5, 0.1, NOT_PROVEN)])
def test_only_hard_rows_with_limits_crossed_beyond_the_slack_are_infeasible(row, gap, status):
    """Row 4 is the last hard row; row 5 is the first soft row, whose limits the caller must not cross."""
    p = Problem(np.eye(8), np.zeros(8), np.eye(8), -np.ones(8), np.ones(8), hard=5)
    p.lower[row] = p.upper[row] + gap
    solution = solve(p)
    assert (solution.status, solution.iterations, solution.active) == (status, 0, 0)
    assert (solution.primal, solution.dual) == (0.0, 0.0), "the crossed limits must prevent a solve"


def test_proven_plan_in_single_precision_is_the_solution():
    """With most inputs at their limits, rounding prevents some proofs of optimality, but no wrong plan is proven."""
    problems = [constrained_problem(seed, steps=15) for seed in range(30)]
    solutions = [solve(p, number="float", slack=1e-5) for p, _ in problems]
    assert {solution.status for solution in solutions} <= {PROVEN, NOT_PROVEN}
    assert np.mean([solution.status == PROVEN for solution in solutions]) > 0.7
    for solution, (_, exact) in zip(solutions, problems, strict=True):
        if solution.status == PROVEN:
            assert solution.plan == pytest.approx(exact.plan, abs=2e-4)
