"""What happens when a measurement, the clock or a solve fails: the ladder down to zero, and back."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_robot import IdealRobot, drive

from diffdrive_mpc.models import Measurement, Stamped, load_model
from diffdrive_mpc.mpc import Controller, Mode, load_config, load_trajectory
from diffdrive_mpc.mpc.qp.solution import Solution
from diffdrive_mpc.mpc.solver.report import SolverReport, SolverStatus
from diffdrive_mpc.mpc.sparse.solver import SparseSolver
from diffdrive_mpc.mpc.ways import CondensedWay

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

    results, poses, times = drive(controller(), robot(), REFERENCE, 12.0, change=lose)
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


def test_called_too_soon_it_repeats_its_command():
    """Else a burst of calls would add up to any acceleration: the slew limit is one per sample."""
    driver, base = controller(), robot()
    results, _, _ = drive(driver, base, REFERENCE, 0.2)
    for k in range(8):
        again = driver.step(base.time - DT + k * 0.001, base.measure())
        assert again.mode is Mode.TRACKING
        assert (again.command == results[-1].command).all()
        assert "repeated" in again.message


def test_a_glitch_of_the_clock_costs_one_tick():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    glitch = driver.step(1e6, base.measure())
    assert glitch.mode is Mode.STOPPED
    assert (glitch.command == 0).all()
    base.advance(glitch.command)
    after = [driver.step(base.time + k * DT, base.measure()) for k in range(2)]
    assert modes(after) == [Mode.TRACKING]


@pytest.mark.parametrize("resume", [True, False])
def test_after_a_long_pause_it_starts_from_rest_or_not_at_all(resume):
    driver, base = controller(**{"failure.resume": resume, "failure.max_position_error": 100.0}), robot()
    drive(driver, base, REFERENCE, 2.0)
    resting = IdealRobot(load_model("ssm").discretise(DT), base.pose)
    results = []
    for k in range(20):
        m = resting.measure()
        t = base.time + 5.0 + k * DT
        m = Measurement(pose=Stamped(m.pose.value, t), wheel_twist=Stamped([0.0, 0.0], t), yaw_rate=Stamped(0.0, t))
        results.append(driver.step(t, m))
    assert "no tick for" in results[0].message
    assert not np.any([r.command for r in results[:2]])
    assert results[-1].mode is (Mode.TRACKING if resume else Mode.STOPPED)
    moving = np.array([r.command for r in results[1:]])
    assert (np.abs(np.diff(moving, axis=0)) <= SLEW + 1e-9).all()


def test_far_from_the_reference_it_stops_and_says_so():
    base = robot()
    base.poses = [base.pose + [0.0, 1.5, 0.0]]
    results, _, _ = drive(controller(), base, REFERENCE, 1.0)
    assert modes(results) == [Mode.STOPPED]
    assert "from the reference; the limit is 1.0 m" in results[-1].message


@pytest.mark.parametrize("wrong", [[0.8, 0.0, 0.0], [0.0, 0.0, 3.0]])
def test_a_first_pose_that_is_wrong_is_noticed_before_the_robot_moves_far(wrong):
    def spoil(k, m):
        return with_pose(m, np.asarray(m.pose.value) + wrong) if k == 0 else m

    results, poses, times = drive(controller(), robot(), REFERENCE, 6.0, change=spoil)
    # Two agreeing poses more, then it brakes: nothing faster than three ticks of slew.
    assert modes(results[:8]) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert np.abs([r.command[0] for r in results[:6]]).max() <= 3 * SLEW[0] + 1e-9
    assert results[-1].mode is Mode.TRACKING
    assert np.abs((poses - REFERENCE.sample(times).pose)[-50:, :2]).max() < 0.01


def test_single_outliers_far_apart_or_delivered_twice_do_not_move_the_robot():
    outlier = [3.0, 3.0, 0.0]

    def spoil(k, m):
        if k in (20, 60, 100, 140):
            return with_pose(m, outlier)
        return with_pose(m, outlier, stamp=140 * DT) if k in (141, 142, 143, 144) else m

    results, poses, times = drive(controller(), robot(), REFERENCE, 4.0, change=spoil)
    assert modes(results) == [Mode.TRACKING]
    assert np.abs((poses - REFERENCE.sample(times).pose)[:, :2]).max() < 0.01


def test_what_the_robot_got_beyond_its_limits_does_not_widen_them():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    for sent in [(4.9, 9.0), (-4.9, -9.0), (1e307, 0.0), ("a", "b"), (None, 1.0), [[1.0], [2.0, 3.0]]]:
        m = base.measure()
        result = driver.step(
            base.time, Measurement(pose=m.pose, wheel_twist=m.wheel_twist, yaw_rate=m.yaw_rate, sent=sent)
        )
        assert (np.abs(result.command) <= [1.5, 2.0]).all()
        base.advance(result.command)


def test_waiting_for_the_first_pose_latches_nothing():
    def late(k, m):
        return with_pose(m, None) if k < 30 else m

    results, _, _ = drive(controller(**{"failure.resume": False}), robot(), REFERENCE, 1.0, change=late)
    assert modes(results) == [Mode.STOPPED, Mode.TRACKING]


def test_carried_away_without_leave_to_resume_it_stays():
    def carry(k, m):
        return with_pose(m, np.asarray(m.pose.value) + [0.0, 0.8, 0.0]) if k >= 100 else m

    results, _, _ = drive(controller(**{"failure.resume": False}), robot(), REFERENCE, 4.0, change=carry)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]


def test_a_plan_is_not_reused_beyond_its_horizon(monkeypatch):
    break_solver(monkeypatch, set(range(60, 80)))
    results, _, _ = drive(controller(horizon=3, **{"failure.max_reused_ticks": 50}), robot(), REFERENCE, 1.6)
    assert sum(r.mode is Mode.REUSED_PLAN for r in results) == 2


WAYS = {
    "condensed/osqp": {},
    "condensed/daqp": {"solver.backend": "daqp"},
    "sparse/osqp": {"solver.formulation": "sparse"},
}
every_way = pytest.mark.parametrize("way", WAYS)


def break_solver(monkeypatch, failing, status=SolverStatus.MAX_ITERATIONS, garbage=2.1e9):
    """Let the solver fail at the given solves, with finite nonsense as its plan."""
    count = iter(range(10**9))

    def failing_solve(solve):
        def wrapped(self, tick, guess):
            solution = solve(self, tick, guess)
            if next(count) in failing:
                return Solution(np.full_like(solution.plan, garbage), SolverReport(status))
            return solution

        return wrapped

    for way in (CondensedWay, SparseSolver):
        monkeypatch.setattr(way, "solve", failing_solve(way.solve))


@every_way
def test_a_failed_solve_uses_the_rest_of_the_last_plan(monkeypatch, way):
    break_solver(monkeypatch, {100, 101})
    results, poses, times = drive(controller(**WAYS[way]), robot(), REFERENCE, 4.0)
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.TRACKING]
    assert results[100].command == pytest.approx(results[99].planned_commands[1], abs=1e-6)
    assert results[101].command == pytest.approx(results[99].planned_commands[2], abs=1e-6)
    assert "iteration limit" in results[100].message
    assert np.abs((poses - REFERENCE.sample(times).pose)[:, :2]).max() < 0.01


@every_way
def test_lasting_failure_goes_down_the_whole_ladder_and_comes_back(monkeypatch, way):
    break_solver(monkeypatch, set(range(100, 180)), status=SolverStatus.INFEASIBLE)
    results, _, _ = drive(controller(**WAYS[way]), robot(), REFERENCE, 6.0)
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert sum(r.mode is Mode.REUSED_PLAN for r in results) == 5
    assert (slews(results) <= SLEW + 1e-12).all()


@every_way
def test_a_plan_that_is_not_finite_is_not_driven(monkeypatch, way):
    break_solver(monkeypatch, {100}, status=SolverStatus.SOLVED, garbage=math.nan)
    results, _, _ = drive(controller(**WAYS[way]), robot(), REFERENCE, 3.0)
    assert results[100].mode is Mode.REUSED_PLAN
    assert np.isfinite([r.command for r in results]).all()


def poison_condensed(way):
    way._solver._multipliers = np.full_like(way._solver._multipliers, 1e12)
    way._solver._kinds = tuple(range(9))


def poison_sparse(way):
    for workspace in way._workspaces.values():
        workspace._dual[:] = 1e12


@every_way
def test_a_failed_warm_start_is_not_carried_on(monkeypatch, way):
    """After a failure the solver starts cold: the next solves succeed, whatever the failed one left behind."""
    chosen, spoil = (SparseSolver, poison_sparse) if "sparse" in way else (CondensedWay, poison_condensed)
    poisoned = []

    def poison(self, tick, guess, solve=chosen.solve):
        solution = solve(self, tick, guess)
        if len(poisoned) == 50:
            spoil(self)
            solution = Solution(solution.plan, SolverReport(SolverStatus.MAX_ITERATIONS))
        poisoned.append(solution.report.status)
        return solution

    monkeypatch.setattr(chosen, "solve", poison)
    # Tight enough that limits matter all the time.
    drive(controller(**WAYS[way] | {"limits.v_slew": 0.3}), robot(), REFERENCE, 2.0)
    assert [status.usable for status in poisoned].count(False) == 1


numbers = st.floats(allow_nan=True, allow_infinity=True)
spoils = st.dictionaries(
    st.integers(1, 59),
    st.one_of(
        st.tuples(st.sampled_from(["pose", "stamp", "wheels", "gyro", "sent", "none", "time"]), numbers, numbers),
        # Values that a robot might report: the dangerous ones are those that look real.
        st.tuples(st.sampled_from(["pose", "wheels", "gyro", "sent"]), st.floats(-6, 6), st.floats(-6, 6)),
        st.tuples(st.sampled_from(["stamp", "time"]), st.floats(-1, 3), st.just(0.0)),
    ),
    max_size=12,
)


@settings(max_examples=75)
@given(spoils, st.integers(3, 20), st.sampled_from(list(WAYS)))
def test_whatever_arrives_the_command_is_finite_and_inside_its_limits(faults, horizon, way):
    driver, base = controller(horizon=horizon, **WAYS[way]), robot()
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
        if result.mode is Mode.STOPPED:
            assert not result.command.any()
        elif kind != "sent":
            assert (np.abs(result.command - last) <= SLEW + 1e-9).all()
        last = result.command
        base.advance(result.command)
