"""A solve that is stopped by its iterations or by the clock: what is driven then, and that it can be repeated."""

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.app.replay.node_log import LoggedConfigs, recorded_drive
from diffdrive_mpc.app.replay.replay import replay
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop
from diffdrive_mpc.mpc.ros.recording import TickRecords
from diffdrive_mpc.mpc.solver.report import SolverStatus

# A robot that can by no means follow: its wheels are too slow, and its corridor is narrow.
HARD = {"horizon": 40, "limits.wheel_speed": 0.1, "limits.corridor": 0.01}


def controller(**overrides):
    return Controller(load_config("ssm", HARD | overrides))


def plant():
    made = make_plant("model:ssm", "ideal", "perfect")
    made.reset(load_trajectory("s").sample([0.0]).pose[0])
    return made


def drive(driven, robot, ticks, **bounds):
    """Results of so many steps; `bounds` gives the arguments that bound each, by the number of the step."""
    driven.start(load_trajectory("s"), robot.time)
    results = []
    for number in range(ticks):
        measured = robot.measure()
        results.append(driven.step(robot.time, measured, **{name: of(number) for name, of in bounds.items()}))
        robot.advance(results[-1].command)
    return results


def priced(program, plan):
    """What a plan costs, soft limits included, from the program's own matrices."""
    cost = 0.5 * plan @ program.H @ plan + program.g @ plan
    weights = load_config("ssm").weights
    for kind in range(4, len(program.lower)):
        values = program.rows(kind) @ plan
        beyond = np.maximum(np.maximum(values - program.upper[kind], program.lower[kind] - values), 0.0)
        cost += weights.soft * beyond.sum() + 0.5 * weights.soft_quadratic * (beyond**2).sum()
    return cost


def inside(limits, dt, plan, last):
    """The plan (2 N,) brought inside ranges and slew, command by command."""
    kept = plan.reshape(-1, 2).copy()
    before = np.array(last)
    for command in kept:
        most, slew = np.array([limits.v, limits.omega]), np.array([limits.v_slew, limits.omega_slew]) * dt
        command[:] = np.clip(command, np.maximum(-most, before - slew), np.minimum(most, before + slew))
        before = command
    return kept.reshape(-1)


def test_a_stopped_plan_keeps_ranges_and_slew_and_costs_no_more_than_the_rest_of_the_last_one():
    driven, robot = controller(**{"solver.active_set_iterations": 3}), plant()
    driven.start(load_trajectory("s"), robot.time)
    limits, dt = driven.config.limits, driven.sample_time
    most, slew = np.array([limits.v, limits.omega]), np.array([limits.v_slew, limits.omega_slew]) * dt
    stopped, last = 0, np.zeros(2)
    for _ in range(150):
        rest = driven.program.guess.copy()
        result = driven.step(robot.time, robot.measure())
        assert result.mode is Mode.TRACKING
        robot.advance(result.command)
        before, last = last, result.command
        if result.solver.status is not SolverStatus.STOPPED:
            continue
        stopped += 1
        assert result.solver.primal_residual == 0.0 and np.isnan(result.solver.dual_residual)
        plan = result.planned_commands
        moves = np.diff(np.vstack([before, plan]), axis=0)
        assert (np.abs(plan) <= most + 1e-12).all()
        assert (np.abs(moves) <= slew + 1e-12).all()
        if rest.any():  # at the first tick there is no plan before it
            cost = priced(driven.program, plan.reshape(-1))
            assert cost <= priced(driven.program, inside(limits, dt, rest, before)) + 1e-9 * abs(cost)
    assert stopped > 50


def test_a_tick_that_the_clock_stopped_is_repeated_bit_for_bit():
    by_clock = drive(controller(), plant(), 60, deadline=lambda k: time.monotonic() + 2e-4 if k % 3 else 1e-9)
    assert SolverStatus.STOPPED_IN_TIME in {result.solver.status for result in by_clock}
    stops = [r.solver.iterations if r.solver.status is SolverStatus.STOPPED_IN_TIME else None for r in by_clock]
    again = drive(controller(), plant(), 60, most_iterations=lambda k: stops[k])
    assert [tuple(r.command) for r in again] == [tuple(r.command) for r in by_clock]
    assert [r.solver.iterations for r in again] == [r.solver.iterations for r in by_clock]


@pytest.mark.parametrize("time_limit", [None, 1e-6])
def test_the_node_bounds_its_solves_by_the_clock_and_its_replay_is_exact(time_limit, tmp_path):
    driven, robot = controller(**({} if time_limit is None else {"solver.time_limit": time_limit})), plant()
    fresh = SimpleNamespace(fault=lambda *_: "", age=lambda _: 0.0)
    inbox = SimpleNamespace(now=0.0, odometry=fresh, newest_pose=None, look_up_pose=lambda: None)
    settings = SimpleNamespace(
        statistics_window=10, drive_on_activate=True, start_at_robot=False, poses_from="odometry", odom_timeout=1.0,
        blocked_timeout=9.0,
    )  # fmt: skip
    deadlines, inner = [], driven.step

    def step(*given, deadline):
        deadlines.append(deadline - time.monotonic())
        return inner(*given, deadline=deadline)

    driven.step = step
    reference = load_trajectory("s")
    loop, records = ControlLoop(driven, settings, inbox, reference, in_sim_time=False), TickRecords(driven)
    lines, results = [], []
    for _ in range(50):
        inbox.now, measured = robot.time, robot.measure()
        inbox.measurement, inbox.newest_pose = lambda kept=measured: kept, measured.pose
        tick = loop.tick()
        if tick.result is not None:
            lines += records.lines(loop.begun, tick)
            results.append(tick.result)
        robot.advance(tick.command)
    limit = time_limit or 0.5 * driven.sample_time
    assert limit - 1e-3 < max(deadlines) <= limit
    late = sum(result.solver.status is SolverStatus.STOPPED_IN_TIME for result in results)
    assert late > 20 if time_limit else late < len(results)
    ticks, drives = ([line for topic, line in lines if topic.endswith(kind)] for kind in ("tick", "drive"))
    log = Path("drive.bag")
    recording = recorded_drive(log, ticks, drives, LoggedConfigs(log, tmp_path))
    again = replay(recording, driven.config, (reference,), as_recorded=True)
    assert [tuple(command) for command in again.command] == [tuple(result.command) for result in results]


@pytest.mark.parametrize("backend", ["osqp", "daqp"])
def test_the_clock_ends_a_backend_too(backend):
    by_backend = controller(**{"solver.method": backend})
    results = drive(by_backend, plant(), 30, deadline=lambda k: 1e-9 if k == 20 else None)
    late = results[20]
    assert late.solver.status is not SolverStatus.SOLVED or late.solver.iterations <= 50
    assert np.isfinite(late.command).all()
    assert results[25].mode is Mode.TRACKING


def test_where_limits_press_everywhere_the_active_set_needs_no_backend():
    run = simulate(controller(), make_plant("model:ssm", seed=1), load_trajectory("s"))
    assert set(run.solver_methods) <= {"none", "unlimited", "active_set"}
    assert {status for status in run.solver_statuses if status} <= {"solved"}
