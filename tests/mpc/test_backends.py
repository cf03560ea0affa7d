"""Every backend of the registry against optimality conditions that do not depend on its method."""

import math
import time
from dataclasses import dataclass
from types import SimpleNamespace

import daqp
import numpy as np
import osqp
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from diffdrive_mpc import Controller, Measurement, Stamped, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop
from diffdrive_mpc.mpc.solver.backend import BACKENDS, SetUpTime, load_backend, solve_all
from diffdrive_mpc.mpc.solver.report import SolverStatus

STEPS, HARD, KINDS = 6, 4, 9
# With these weights, some soft limits are exceeded and others are satisfied.
WEIGHTS = load_config("ssm", {"weights.soft": 3.0, "weights.soft_quadratic": 20.0}).weights
every_backend = pytest.mark.parametrize("backend", BACKENDS)


@dataclass
class PlainProgram:
    """Program in NumPy arrays, with the interface of `mpc.solver.backend.Program`."""

    H: np.ndarray
    g: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    soft: np.ndarray
    kinds: tuple = ()

    def __post_init__(self):
        self.guess, self.multipliers = np.zeros(2 * STEPS), np.zeros((KINDS, STEPS))

    def rows(self, kind):
        return self.soft[kind - HARD]

    def all_rows(self):
        commands = np.eye(2 * STEPS)
        increments = commands.copy()
        increments[2:] -= commands[:-2]
        hard = [commands[0::2], commands[1::2], increments[0::2], increments[1::2]]
        return np.stack([*hard, *self.soft])

    def excess(self, plan):
        values = self.all_rows() @ plan
        return np.maximum(values - self.upper, self.lower - values)

    def violated_kinds(self, plan, margin):
        return tuple(np.flatnonzero(self.excess(plan).max(axis=1) > margin).tolist())


def random_program(seed, tightness=0.5, softness=1.0):
    """Return a strictly convex program; about `tightness` of its limits are active."""
    rng = np.random.default_rng(seed)
    n = 2 * STEPS
    root = rng.normal(size=(n, n))
    last, box, slew = (
        rng.uniform(-0.2, 0.2, 2),
        rng.uniform(0.2, 0.4, 2) / tightness,
        rng.uniform(0.2, 0.4, 2) / tightness,
    )
    middle = rng.normal(scale=0.3, size=(5, STEPS))
    width = rng.uniform(0.5, 2.0, (5, STEPS)) / tightness
    upper = np.concatenate([np.tile(np.concatenate([box, slew])[:, None], STEPS), middle + width])
    lower = np.concatenate([-upper[:HARD], middle - width])
    upper[2:HARD, 0] += last
    lower[2:HARD, 0] += last
    H = root @ root.T + 5 * np.eye(n)
    return PlainProgram(H, rng.normal(scale=12.0, size=n), lower, upper, softness * rng.normal(size=(5, STEPS, n)))


def solver_settings(backend, max_iterations=100_000):
    common = {"tolerance": 1e-8, "max_iterations": max_iterations}
    osqp_settings = {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": max_iterations, "check_termination": 10}
    return load_config("ssm", {"solver": {"method": backend, "osqp": osqp_settings, **common}}).solver


def solve(program, backend, **changes):
    """Solve from a cold start."""
    solver = load_backend(backend)(STEPS, KINDS, solver_settings(backend, **changes), WEIGHTS)
    return solver.solve(program, tuple(range(KINDS)), program.guess, program.multipliers)


def assert_optimal(program, plan, multipliers, tolerance):
    rows, price, slope = program.all_rows(), WEIGHTS.soft, WEIGHTS.soft_quadratic
    constraint_force = np.einsum("ks,ksu->u", multipliers, rows)
    assert program.H @ plan + program.g + constraint_force == pytest.approx(np.zeros(2 * STEPS), abs=tolerance)
    values = rows @ plan
    over, under = values - program.upper, program.lower - values
    assert np.maximum(over, under)[:HARD].max() <= tolerance
    # Only active limits have multipliers, with the sign of an inward force.
    assert over[multipliers > 10 * tolerance].min(initial=0.0) >= -tolerance
    assert under[multipliers < -10 * tolerance].min(initial=0.0) >= -tolerance
    # The multiplier of a satisfied soft limit is at most its price, that of an exceeded limit its marginal cost.
    excess, size = np.maximum(np.maximum(over, under)[HARD:], 0), np.abs(multipliers[HARD:])
    exceeded = excess > 10 * tolerance
    assert (size <= price + slope * excess + 100 * tolerance).all()
    assert size[exceeded] == pytest.approx(price + slope * excess[exceeded], abs=100 * tolerance)


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.floats(0.2, 2.0))
def test_solution_of_daqp_is_optimal(seed, tightness):
    program = random_program(seed, tightness)
    solution = solve(program, "daqp")
    assert solution.status is SolverStatus.SOLVED
    assert_optimal(program, solution.plan, solution.multipliers, 1e-7)


@settings(max_examples=15)
@given(st.integers(0, 10_000))
def test_solution_of_osqp_is_optimal(seed):
    program = random_program(seed)
    solution = solve(program, "osqp")
    assume(solution.status is SolverStatus.SOLVED)
    assert_optimal(program, solution.plan, solution.multipliers, 1e-5)


def test_random_programs_exercise_all_limits():
    """The tests above would be weak if few limits were active."""
    programs = [random_program(seed) for seed in range(40)]
    solutions = [solve(program, "daqp") for program in programs]
    multipliers = np.array([np.abs(solution.multipliers).max(axis=1) > 0 for solution in solutions])
    assert (multipliers.mean(axis=0) > 0.1).all()
    exceeded = [
        (program.excess(solution.plan)[HARD:] > 1e-6).any()
        for program, solution in zip(programs, solutions, strict=True)
    ]
    assert 0.2 < np.mean(exceeded) < 1.0


@every_backend
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), tightness=st.floats(0.02, 0.6))
def test_adding_violated_limits_gives_the_full_solution(backend, seed, tightness):
    program = random_program(seed, tightness, softness=0.3)
    full = solve(program, "daqp")
    solution, report = solve_all(
        load_backend(backend)(STEPS, KINDS, solver_settings(backend), WEIGHTS), program, backend, 1e-9
    )
    assume(report.status is SolverStatus.SOLVED)
    assert solution.plan == pytest.approx(full.plan, abs=1e-5)
    assert report.method == backend


@every_backend
def test_nan_in_a_program_is_reported(backend):
    program = random_program(0)
    program.g = np.full_like(program.g, np.nan)
    _, report = solve_all(
        load_backend(backend)(STEPS, KINDS, solver_settings(backend), WEIGHTS), program, backend, 1e-9
    )
    assert not report.status.usable


@every_backend
def test_backend_stops_at_its_iteration_limit(backend):
    """OSQP needs more than 10 iterations for useful tolerances; DAQP needs more if enough limits are active."""
    program = random_program(0, tightness=2.0)
    assert solve(program, backend).status is SolverStatus.SOLVED
    stopped = solve(program, backend, max_iterations=10)
    assert stopped.status is SolverStatus.MAX_ITERATIONS
    assert stopped.iterations <= 11  # DAQP counts the iteration at which it stops


def test_backend_solves_if_the_active_set_has_no_iterations():
    tight = {"limits.v_slew": 0.9, "limits.omega_slew": 1.5, "limits.omega": 0.51, "limits.predicted_v": 0.48}
    config = load_config("ssm", {"horizon": 15, **tight})
    drives = {}
    for iterations in (0, 500):
        limited = config.model_copy(
            update={"solver": config.solver.model_copy(update={"active_set_iterations": iterations})}
        )
        drives[iterations] = simulate(
            Controller(limited), make_plant("model:ssm", "ideal", "perfect"), load_trajectory("circle")
        )
    without_iterations, with_iterations = (np.array(drives[iterations].solver_methods) for iterations in (0, 500))
    assert "daqp" not in with_iterations
    is_active = with_iterations == "active_set"
    assert is_active.sum() > 20
    assert set(without_iterations[is_active]) == {"daqp"}
    # The method does not change the motion of the robot.
    assert drives[0].command == pytest.approx(drives[500].command, abs=1e-5)


@every_backend
def test_backend_plan_equals_the_active_set_with_active_limits(backend):
    """Problems of a drive are solved again from the core's memory."""
    limits = {"limits.v_slew": 0.9, "limits.omega_slew": 1.5, "limits.omega": 0.51, "limits.predicted_v": 0.48}
    controller = Controller(load_config("ssm", limits | {"horizon": 15}))
    plant, reference = make_plant("model:ssm", "ideal", "perfect"), load_trajectory("circle")
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    exact = load_backend(backend)(15, KINDS, solver_settings(backend), controller.config.weights)
    compared = 0
    for _ in range(120):
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
        if step.solver.method == "active_set":
            solution, report = solve_all(exact, controller.program, backend, 1e-9)
            assert report.status is SolverStatus.SOLVED
            assert solution.plan == pytest.approx(step.planned_commands.reshape(-1), abs=2e-5)
            compared += 1
    assert compared > 20


def test_violated_limit_is_detected_at_every_step():
    """Each bound is exceeded by more and by less than the margin; limits of the other command are not violated."""
    reference = load_trajectory("s")
    controller = Controller(load_config("ssm", {"limits.v": 0.6, "limits.omega": 1.0}))
    controller.start(reference, 0.0)
    controller.step(0.0, Measurement(pose=Stamped(reference.sample([0.0]).pose[0], 0.0)))
    program = controller._program
    for row, channel in np.ndindex(controller.config.horizon, 2):
        for bounds, excess in ((program.upper, 0.01), (program.lower, -0.01)):
            plan = np.zeros(2 * controller.config.horizon)
            plan[2 * row + channel] = bounds[channel, row] + excess
            assert [kind for kind in program.violated_kinds(plan, 0.005) if kind < 2] == [channel]
            assert [kind for kind in program.violated_kinds(plan, 0.02) if kind < 2] == []


# Stopped solves.

# A robot that cannot follow its reference: its wheels are slow, and its corridor is narrow.
DEMANDING = {"horizon": 40, "limits.wheel_speed": 0.1, "limits.corridor": 0.01}


def controller(**overrides):
    return Controller(load_config("ssm", DEMANDING | overrides))


def plant():
    result = make_plant("model:ssm", "ideal", "perfect")
    result.reset(load_trajectory("s").sample([0.0]).pose[0])
    return result


def drive(driver, robot, ticks, **bounds):
    """Return the results of `ticks` steps; `bounds` maps arguments of `step` to functions of the step number."""
    driver.start(load_trajectory("s"), robot.time)
    results = []
    for number in range(ticks):
        measurement = robot.measure()
        results.append(driver.step(robot.time, measurement, **{name: bound(number) for name, bound in bounds.items()}))
        robot.advance(results[-1].command)
    return results


def plan_cost(program, plan):
    """Return the cost of a plan, soft limits included, from the matrices of the program."""
    cost = 0.5 * plan @ program.H @ plan + program.g @ plan
    weights = load_config("ssm").weights
    for kind in range(4, len(program.lower)):
        values = program.rows(kind) @ plan
        violation = np.maximum(np.maximum(values - program.upper[kind], program.lower[kind] - values), 0.0)
        cost += weights.soft * violation.sum() + 0.5 * weights.soft_quadratic * (violation**2).sum()
    return cost


def clip_to_limits(limits, dt, plan, last):
    """Return the plan (2 N,) clipped to ranges and slew, command by command."""
    clipped = plan.reshape(-1, 2).copy()
    previous = np.array(last)
    for command in clipped:
        ranges, slew = np.array([limits.v, limits.omega]), np.array([limits.v_slew, limits.omega_slew]) * dt
        command[:] = np.clip(command, np.maximum(-ranges, previous - slew), np.minimum(ranges, previous + slew))
        previous = command
    return clipped.reshape(-1)


def test_stopped_plan_is_feasible_and_no_worse_than_the_previous_plan():
    driver, robot = controller(**{"solver.active_set_iterations": 3}), plant()
    driver.start(load_trajectory("s"), robot.time)
    limits, dt = driver.config.limits, driver.sample_time
    ranges, slew = np.array([limits.v, limits.omega]), np.array([limits.v_slew, limits.omega_slew]) * dt
    stopped, last = 0, np.zeros(2)
    for _ in range(150):
        guess = driver.program.guess.copy()
        result = driver.step(robot.time, robot.measure())
        assert result.mode is Mode.TRACKING
        robot.advance(result.command)
        previous, last = last, result.command
        if result.solver.status is not SolverStatus.STOPPED:
            continue
        stopped += 1
        assert result.solver.primal_residual == 0.0 and np.isnan(result.solver.dual_residual)
        plan = result.planned_commands
        moves = np.diff(np.vstack([previous, plan]), axis=0)
        assert (np.abs(plan) <= ranges + 1e-12).all()
        assert (np.abs(moves) <= slew + 1e-12).all()
        if guess.any():  # the first tick has no previous plan
            cost = plan_cost(driver.program, plan.reshape(-1))
            assert cost <= plan_cost(driver.program, clip_to_limits(limits, dt, guess, previous)) + 1e-9 * abs(cost)
    assert stopped > 50


def test_tick_stopped_by_the_clock_is_reproduced_exactly():
    is_late = [k % 3 == 0 or 30 < k < 40 for k in range(60)]
    timed = drive(controller(), plant(), 60, deadline=lambda k: 1e-9 if is_late[k] else time.monotonic() + 2e-4)
    assert SolverStatus.STOPPED_IN_TIME in {result.solver.status for result in timed}
    stops = [max(r.solver.iterations, 1) if r.solver.missed else None for r in timed]
    assert Mode.BRAKING in {result.mode for result in timed}
    repeated = drive(controller(), plant(), 60, most_iterations=lambda k: stops[k])
    assert [r.mode for r in repeated] == [r.mode for r in timed]
    assert [tuple(r.command) for r in repeated] == [tuple(r.command) for r in timed]
    assert [r.solver.iterations for r in repeated] == [r.solver.iterations for r in timed]


@pytest.mark.parametrize("time_limit", [None, 1e-6])
def test_node_limits_the_time_of_solves(time_limit):
    driver, robot = controller(**({} if time_limit is None else {"solver.time_limit": time_limit})), plant()
    odometry = SimpleNamespace(fault=lambda *_: "", age=lambda _: 0.0)
    inbox = SimpleNamespace(now=0.0, odometry=odometry, newest_pose=None, look_up_pose=lambda: None)
    settings = SimpleNamespace(
        statistics_window=10, drive_on_activate=True, start_at_robot=False, poses_from="odometry", odom_timeout=1.0,
        blocked_timeout=9.0,
    )  # fmt: skip
    deadlines, inner, results = [], driver.step, []

    def step(*arguments, deadline):
        deadlines.append(deadline - time.monotonic())
        return inner(*arguments, deadline=deadline)

    driver.step = step
    loop = ControlLoop(driver, settings, inbox, load_trajectory("s"), in_sim_time=False)
    for _ in range(50):
        inbox.now, measurement = robot.time, robot.measure()
        inbox.measurement, inbox.newest_pose = lambda latest=measurement: latest, measurement.pose
        tick = loop.tick()
        results += [tick.result] if tick.result is not None else []
        robot.advance(tick.command)
    limit = time_limit or 0.5 * driver.sample_time
    assert limit - 1e-3 < max(deadlines) <= limit
    late_count = sum(result.solver.status is SolverStatus.STOPPED_IN_TIME for result in results)
    assert late_count > 20 if time_limit else late_count < len(results)


@pytest.mark.parametrize("backend", ["osqp", "daqp"])
def test_backend_that_runs_out_of_time_returns_no_plan_and_replay_is_exact(backend):
    driver = controller(**{"solver.method": backend})
    results = drive(driver, plant(), 30, deadline=lambda k: 1e-9 if k == 20 else None)
    late = results[20]
    assert late.solver.status is SolverStatus.TIME_LIMIT
    assert (late.mode, late.solver.missed) == (Mode.REUSED_PLAN, 1)
    assert results[25].mode is Mode.TRACKING
    odd_limits = drive(
        controller(**{"solver.method": backend}), plant(), 3, deadline=lambda k: [math.inf, math.nan, None][k]
    )
    assert [result.solver.status is SolverStatus.SOLVED for result in odd_limits] == [True, False, True]
    repeated = drive(
        controller(**{"solver.method": backend}), plant(), 30, most_iterations=lambda k: 0 if k == 20 else None
    )
    assert [tuple(r.command) for r in repeated] == [tuple(r.command) for r in results]


@every_backend
@pytest.mark.parametrize("kinds", [HARD, KINDS])
def test_factorisation_that_would_exceed_the_time_limit_is_not_started(backend, kinds, monkeypatch):
    calls, steps = [], 100
    for owner, name in ((daqp, "Model"), (osqp.OSQP, "setup"), (osqp.OSQP, "update")):
        inner = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, inner=inner, **b: [calls.append(inner), inner(*a, **b)][1])
    solver = load_backend(backend)(steps, KINDS, solver_settings(backend), WEIGHTS)
    rows = np.tile(np.tri(steps).repeat(2, axis=1), (KINDS, 1, 1))
    H, bounds = np.eye(2 * steps) + 0.1, np.full((KINDS, steps), 0.1)
    program = SimpleNamespace(H=H, g=np.ones(2 * steps), lower=-bounds, upper=bounds, rows=lambda kind: rows[kind])
    guess, multipliers = np.zeros(2 * steps), np.zeros((KINDS, steps))
    calls.clear()
    # Each backend needs a millisecond here, and more with soft limits.
    solution = solver.solve(program, tuple(range(kinds)), guess, multipliers, 5e-5)
    assert (solution.status, solution.iterations, calls) == (SolverStatus.TIME_LIMIT, 0, [])
    solution = solver.solve(program, tuple(range(kinds)), guess, multipliers, 30.0)
    assert solution.status.usable
    assert calls
    # A solver that is started nevertheless stops by its own clock, which DAQP reads every 32nd iteration.
    monkeypatch.setattr(SetUpTime, "expected", lambda *_: 0.0)
    solution = solver.solve(program, tuple(range(kinds)), guess, multipliers, 1e-9)
    assert solution.status is SolverStatus.TIME_LIMIT
    assert solution.iterations <= 32


def test_time_of_a_factorisation_is_its_shortest_measurement(monkeypatch):
    clock = iter([0.0, 4.0, 10.0, 11.0, 20.0, 26.0])
    monkeypatch.setattr(time, "thread_time", lambda: next(clock))
    set_up_time = SetUpTime()
    assert set_up_time.expected(3.0) == 0.0
    for expected in (2.0, 0.5, 0.5):
        with set_up_time.measured(2.0):
            pass
        assert set_up_time.expected() == expected
    assert set_up_time.expected(3.0) == 1.5


def test_robot_brakes_after_missed_deadlines_and_resumes_in_time():
    limit = 4
    late_ticks = range(20, 32)
    driver = controller(**{"solver.max_missed": limit})
    results = drive(driver, plant(), 60, deadline=lambda k: 1e-9 if k in late_ticks else None)
    assert [r.solver.missed for r in results[19:33]] == [0, *range(1, len(late_ticks) + 1), 0]
    modes = [result.mode for result in results]
    assert set(modes[20 : 19 + limit]) == {Mode.TRACKING}
    braking = slice(19 + limit, 32)
    assert set(modes[braking]) <= {Mode.BRAKING, Mode.STOPPED}
    assert all("missed their deadline" in result.message for result in results[braking])
    speeds = [abs(result.command[0]) for result in results[braking]]
    assert speeds == sorted(speeds, reverse=True)
    assert modes[32] is Mode.TRACKING


def test_missed_deadlines_stop_the_robot_permanently_without_resume():
    driver = controller(**{"solver.max_missed": 2, "failure.resume": False})
    results = drive(driver, plant(), 40, deadline=lambda k: 1e-9 if k in (20, 21) else None)
    assert results[20].mode is Mode.TRACKING
    assert all(result.mode in (Mode.BRAKING, Mode.STOPPED) for result in results[21:])
    assert "call start or resume" in results[-1].message


def test_late_step_is_counted_as_missed_without_active_limits():
    results = drive(Controller("ssm"), plant(), 84, deadline=lambda k: time.monotonic() - 1.0 if k >= 80 else None)
    assert [result.solver.missed for result in results[79:]] == [0, 1, 2, 3, 4]
    assert "unlimited" in {result.solver.method for result in results[80:]}
