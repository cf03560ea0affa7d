"""What happens when a measurement, the clock or a solve fails: the ladder down to zero, and back."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot, drive

from models import Measurement, Stamped, load_model
from mpc import Controller, Mode, load_config, load_trajectory
from mpc.osqp_solver import OsqpSolver, Solution
from mpc.solver_report import SolverReport, SolverStatus

DT = 0.0202
REFERENCE = load_trajectory("circle")
SLEW = np.array([2.0, 6.0]) * DT


def controller(**overrides):
    return Controller(load_config("ssm", overrides))


def robot():
    return IdealRobot(load_model("ssm").discretise(DT), REFERENCE.sample([0.0]).pose[0])


def modes(results):
    """The modes in order, repetitions left out."""
    sequence = [result.mode for result in results]
    return [mode for k, mode in enumerate(sequence) if k == 0 or mode != sequence[k - 1]]


def slews(results):
    commands = np.array([result.command for result in results])
    return np.abs(np.diff(commands, axis=0))


def with_pose(measurement, value, stamp=None):
    return Measurement(
        pose=None if value is None else Stamped(value, measurement.pose.time if stamp is None else stamp),
        wheel_twist=measurement.wheel_twist,
        yaw_rate=measurement.yaw_rate,
    )


def test_a_single_bad_pose_does_not_disturb_the_drive():
    def spoil(k, m):
        return with_pose(m, [np.nan, 0.0, 0.0]) if k == 100 else m

    results, poses, times = drive(controller(), robot(), REFERENCE, 5.0, change=spoil)
    assert modes(results) == [Mode.TRACKING]
    assert "pose rejected" in results[100].message
    assert np.abs((poses - REFERENCE.sample(times).pose)[:, :2]).max() < 0.01


def test_without_poses_it_dead_reckons_then_brakes_then_stands():
    def lose(k, m):
        return with_pose(m, [np.nan] * 3) if k >= 100 else m

    results, _, _ = drive(controller(), robot(), REFERENCE, 5.0, change=lose)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]
    first_brake = next(k for k, r in enumerate(results) if r.mode is Mode.BRAKING)
    assert (first_brake - 99) * DT == pytest.approx(0.5, abs=2 * DT)
    assert "no pose was accepted" in results[first_brake].message
    assert (slews(results) <= SLEW + 1e-12).all()
    assert (results[-1].command == 0).all()


def test_it_drives_on_when_poses_return():
    def lose(k, m):
        return with_pose(m, None) if 100 <= k < 160 else m

    results, poses, times = drive(controller(), robot(), REFERENCE, 9.0, change=lose)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert np.abs((poses - REFERENCE.sample(times).pose)[-50:, :2]).max() < 0.02


def test_it_stays_stopped_where_resuming_is_not_allowed():
    def lose(k, m):
        return with_pose(m, None) if 100 <= k < 140 else m

    results, _, _ = drive(controller(**{"failure.resume": False}), robot(), REFERENCE, 6.0, change=lose)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]
    assert "call start or reset" in results[-1].message


def test_no_pose_at_all_means_no_motion():
    results, _, _ = drive(controller(), robot(), REFERENCE, 1.0, change=lambda k, m: with_pose(m, None))
    assert modes(results) == [Mode.STOPPED]
    assert "no pose has arrived yet" in results[-1].message
    assert not np.any([r.command for r in results])


def test_a_robot_that_was_carried_away_stops_and_drives_on_from_there():
    def carry(k, m):
        return with_pose(m, np.asarray(m.pose.value) + [0.0, 0.8, 0.0]) if k >= 100 else m

    results, _, _ = drive(controller(), robot(), REFERENCE, 6.0, change=carry)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert "jumps" in results[100].message


def test_time_running_backwards_brakes_and_is_named():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    results = [driver.step(1.0 - k * DT, base.measure()) for k in range(40)]
    assert modes(results) == [Mode.BRAKING, Mode.STOPPED]
    assert all("time ran backwards" in r.message for r in results)
    assert (slews(results) <= SLEW + 1e-12).all()


@pytest.mark.parametrize("t", [math.nan, math.inf])
def test_a_tick_without_a_time_brakes(t):
    driver, base = controller(), robot()
    results, _, _ = drive(driver, base, REFERENCE, 2.0)
    result = driver.step(t, base.measure())
    assert result.mode is Mode.BRAKING
    assert np.abs(result.command).max() < np.abs(results[-1].command).max()


def test_the_same_time_twice_is_no_new_tick():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    result = driver.step(base.time - DT, base.measure())
    assert result.mode is Mode.BRAKING


def break_solver(monkeypatch, failing, status=SolverStatus.MAX_ITERATIONS, garbage=2.1e9):
    """Let the solver fail at the given solves, with finite nonsense as its plan."""
    solve, count = OsqpSolver.solve, iter(range(10**9))

    def failing_solve(self, qp, guess):
        solution = solve(self, qp, guess)
        if next(count) in failing:
            return Solution(np.full_like(solution.plan, garbage), SolverReport(status))
        return solution

    monkeypatch.setattr(OsqpSolver, "solve", failing_solve)


def test_a_failed_solve_uses_the_rest_of_the_last_plan(monkeypatch):
    break_solver(monkeypatch, {100, 101})
    results, poses, times = drive(controller(), robot(), REFERENCE, 4.0)
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.TRACKING]
    assert results[100].command == pytest.approx(results[99].planned_commands[1], abs=1e-6)
    assert results[101].command == pytest.approx(results[99].planned_commands[2], abs=1e-6)
    assert "iteration limit" in results[100].message
    assert np.abs((poses - REFERENCE.sample(times).pose)[:, :2]).max() < 0.01


def test_lasting_failure_goes_down_the_whole_ladder_and_comes_back(monkeypatch):
    break_solver(monkeypatch, set(range(100, 180)), status=SolverStatus.INFEASIBLE)
    results, _, _ = drive(controller(), robot(), REFERENCE, 6.0)
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert sum(r.mode is Mode.REUSED_PLAN for r in results) == 5
    assert (slews(results) <= SLEW + 1e-12).all()


def test_a_plan_that_is_not_finite_is_not_driven(monkeypatch):
    break_solver(monkeypatch, {100}, status=SolverStatus.SOLVED, garbage=math.nan)
    results, _, _ = drive(controller(), robot(), REFERENCE, 3.0)
    assert results[100].mode is Mode.REUSED_PLAN
    assert np.isfinite([r.command for r in results]).all()


def test_a_failed_warm_start_is_not_carried_on(monkeypatch):
    """After a failure the solver starts cold: the next solves succeed, whatever the failed one left behind."""
    poisoned = []

    def poison(self, qp, guess, solve=OsqpSolver.solve):
        solution = solve(self, qp, guess)
        if len(poisoned) == 50:
            for workspace in self._workspaces.values():
                workspace._dual[:] = 1e12
            solution = Solution(solution.plan, SolverReport(SolverStatus.MAX_ITERATIONS))
        poisoned.append(solution.report.status)
        return solution

    monkeypatch.setattr(OsqpSolver, "solve", poison)
    drive(controller(), robot(), REFERENCE, 2.0)
    assert [status.usable for status in poisoned].count(False) == 1


numbers = st.floats(allow_nan=True, allow_infinity=True)
spoils = st.dictionaries(
    st.integers(1, 59),
    st.tuples(st.sampled_from(["pose", "stamp", "wheels", "gyro", "sent", "none", "time"]), numbers, numbers),
    max_size=12,
)


@settings(max_examples=60)
@given(spoils, st.integers(3, 20))
def test_whatever_arrives_the_command_is_finite_and_inside_its_limits(faults, horizon):
    driver, base = controller(horizon=horizon), robot()
    driver.start(REFERENCE, 0.0)
    last = np.zeros(2)
    for k in range(60):
        m, t = base.measure(), base.time
        kind, a, b = faults.get(k, ("", 0.0, 0.0))
        pose, wheels, gyro, sent = m.pose, m.wheel_twist, m.yaw_rate, None
        if kind == "pose":
            pose = Stamped([a, b, 0.0], t)
        elif kind == "stamp":
            pose = Stamped(m.pose.value, a)
        elif kind == "wheels":
            wheels = Stamped([a, b], t)
        elif kind == "gyro":
            gyro = Stamped(a, t)
        elif kind == "sent":
            sent = (a, b)
        elif kind == "none":
            pose = wheels = gyro = None
        elif kind == "time":
            t = a
        result = driver.step(t, Measurement(pose=pose, wheel_twist=wheels, yaw_rate=gyro, sent=sent))
        assert np.isfinite(result.command).all()
        assert (np.abs(result.command) <= [1.5, 2.0]).all()
        if kind != "sent":
            assert (np.abs(result.command - last) <= SLEW + 1e-9).all()
        last = result.command
        base.advance(result.command)
