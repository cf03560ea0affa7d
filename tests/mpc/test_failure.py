"""Failures of measurements, clock and solver: the sequence of modes until standstill, and recovery."""

import math
from dataclasses import replace

import numpy as np
import pytest
from failing_solver import BACKENDS, CorruptedReference, FailingSolver
from ideal_robot import IdealRobot, drive

from diffdrive_mpc.models import Measurement, Stamped, load_model
from diffdrive_mpc.mpc import Controller, Mode, load_config, load_trajectory
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.solver.report import SolverStatus

DT = 0.0202
REFERENCE = load_trajectory("circle")
SLEW = np.array([2.0, 6.0]) * DT


def controller(**overrides):
    return Controller(load_config("ssm", overrides))


def robot():
    return IdealRobot(load_model("ssm").discretise(DT), REFERENCE.sample([0.0]).pose[0])


def modes(results):
    """Return the modes in order, without repetitions."""
    sequence = [result.mode for result in results]
    return [mode for k, mode in enumerate(sequence) if k == 0 or mode != sequence[k - 1]]


def slews(results):
    commands = np.array([result.command for result in results])
    return np.abs(np.diff(commands, axis=0))


@pytest.mark.parametrize(("dead_reckoning", "braking_time"), [(0.0, 0.5), (1.5, 1.5)])
def test_missing_poses_lead_to_dead_reckoning_braking_and_standstill(dead_reckoning, braking_time):
    tracker = controller(**{"failure.dead_reckoning": dead_reckoning})
    results, _, _ = drive(tracker, robot(), REFERENCE, 5.0, change=bad_poses(*range(100, 300), value=[np.nan] * 3))
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]
    first_brake = next(k for k, r in enumerate(results) if r.mode is Mode.BRAKING)
    assert (first_brake - 99) * DT == pytest.approx(braking_time, abs=2 * DT)
    assert "no pose was accepted" in results[first_brake].message
    assert (slews(results) <= SLEW + 1e-12).all()
    assert (results[-1].command == 0).all()


def without_poses(start, *, wheels=True):
    """Return a change for `drive`: from tick `start` on, no pose arrives in the first 1.2 s of every 1.8 s."""

    def change(k, m):
        if k < start or (k - start) * DT % 1.8 >= 1.2:
            return m
        return replace(m, pose=None) if wheels else Measurement(yaw_rate=m.yaw_rate)

    return change


def bad_poses(*ticks, value=(np.nan, 0.0, 0.0), repeated=()):
    """Return a change for `drive`: a wrong value in `ticks`, with the stamp of the last of them in `repeated`."""

    def change(k, m):
        stamp = ticks[-1] * DT if k in repeated else m.pose.time
        pose = None if value is None else Stamped(value, stamp)
        return replace(m, pose=pose) if k in (*ticks, *repeated) else m

    return change


OUTLIERS = bad_poses(20, 60, 100, 140, value=(3.0, 3.0, 0.0), repeated=(141, 142, 143, 144))
STOP_AND_RESUME = [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]


@pytest.mark.parametrize(
    ("dead_reckoning", "seconds", "change", "sequence", "rows", "bound", "messages"),
    [
        (1.5, 5.0, bad_poses(100), [Mode.TRACKING], slice(None), 0.01, {100: "pose rejected"}),
        (1.5, 4.0, OUTLIERS, [Mode.TRACKING], slice(None), 0.01, {}),
        (2.0, 9.0, without_poses(100), [Mode.TRACKING], slice(None), 0.03, {}),
        (0.0, 12.0, bad_poses(*range(100, 160), value=None), STOP_AND_RESUME, slice(-50, None), 0.02, {}),
    ],
    ids=["single bad pose", "outliers", "gaps", "poses return"],
)
def test_drive_with_bad_poses_stays_on_the_reference(dead_reckoning, seconds, change, sequence, rows, bound, messages):
    """`dead_reckoning` is its maximum duration [s], and `bound` the maximum position error in `rows` [m]."""
    driver = controller(**{"failure.dead_reckoning": dead_reckoning})
    results, poses, times = drive(driver, robot(), REFERENCE, seconds, change=change)
    assert modes(results) == sequence
    assert np.abs((poses - REFERENCE.sample(times).pose)[rows, :2]).max() < bound
    assert all(text in results[tick].message for tick, text in messages.items())


def test_speed_falls_with_position_uncertainty_before_braking():
    driver = controller(**{"failure.dead_reckoning": 5.0, "reentry.band": 0.03})
    results, _, _ = drive(driver, robot(), REFERENCE, 6.0, change=bad_poses(*range(100, 300), value=None))
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]
    first_brake = next(k for k, r in enumerate(results) if r.mode is Mode.BRAKING)
    progress = np.array([r.progress for r in results[100:first_brake]])
    assert progress[0] == 1.0
    assert (np.diff(progress) <= 1e-9).all()
    assert progress[-1] < 0.3
    assert results[first_brake].command[0] < 0.75 * results[100].command[0]


@pytest.mark.parametrize(("wheels", "band"), [(False, 0.08), (True, 0.015)])
def test_dead_reckoning_ends_without_wheels_or_beyond_the_band(wheels, band):
    """Dead reckoning is unreliable in these cases: the usual age limit of poses applies."""
    driver = controller(**{"failure.dead_reckoning": 2.0, "reentry.band": band})
    results, _, _ = drive(driver, robot(), REFERENCE, 4.0, change=without_poses(100, wheels=wheels))
    assert Mode.BRAKING in modes(results)
    first_brake = next(k for k, r in enumerate(results) if r.mode is Mode.BRAKING)
    assert (first_brake - 99) * DT < 1.2


def rare_poses(interval, latency, end=math.inf):
    """Return a change for `drive`: until `end` [s], one pose per `interval`, with a delay of `latency` [samples]."""
    queue = []

    def change(k, m):
        if k * DT >= end:
            return m
        if k % interval == 0:
            queue.append((k + latency, m.pose))
        pose = queue.pop(0)[1] if queue and queue[0][0] <= k else None
        return replace(m, pose=pose)

    return change


@pytest.mark.parametrize(
    ("interval", "latency", "max_pose_age", "stops"),
    [(26, 5, 0.5, 1), (10, 18, 0.5, 1), (26, 5, 0.65, 0), (10, 18, 0.65, 0), (60, 0, 0.5, 1)],
)
def test_rare_poses_stop_the_robot_once_with_the_remedy(interval, latency, max_pose_age, stops):
    """The robot brakes `stops` times, then stops; the setting in its message enables the drive."""
    tracker = controller(**{"failure.max_pose_age": max_pose_age, "failure.dead_reckoning": 0.0})
    results, _, _ = drive(tracker, robot(), REFERENCE, 6.0, change=rare_poses(interval, latency))
    order = modes(results)
    assert order.count(Mode.BRAKING) == stops
    if stops:
        assert order[-1] is Mode.STOPPED
        message = results[-1].message
        assert f"poses come every {interval * DT:.2f} s and {latency * DT:.2f} s late" in message
        assert f"raise it above {(interval + latency) * DT:.2f} s" in message
        first = next(k for k, r in enumerate(results) if "poses come every" in r.message)
        assert first == interval + latency, "two poses are enough to detect the rate"
    else:
        assert not any("poses come every" in r.message for r in results)


def test_single_dropout_does_not_change_the_pose_rate():
    dropouts = bad_poses(*(k for k in range(400) if k % 150 > 115), value=None)
    results, _, _ = drive(controller(**{"failure.dead_reckoning": 0.0}), robot(), REFERENCE, 8.0, change=dropouts)
    assert any(r.mode is Mode.BRAKING for r in results)
    assert not any("poses come every" in r.message for r in results)


def test_poses_older_than_the_history_are_reported_with_the_remedy():
    tracker = controller(**{"estimator.history": 0.2})
    results, _, _ = drive(tracker, robot(), REFERENCE, 2.0, change=rare_poses(5, 15))
    assert {r.mode for r in results} == {Mode.STOPPED}
    assert all("0.30 s late" in r.message and "raise estimator.history" in r.message for r in results[20:])


def test_backward_time_brakes_and_is_reported():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    results = [driver.step(1.0 - k * DT, base.measure()) for k in range(40)]
    assert modes(results) == [Mode.BRAKING, Mode.STOPPED]
    assert all("time ran backwards" in r.message for r in results)
    assert (slews(results) <= SLEW + 1e-12).all()


def test_early_call_repeats_the_command():
    """The slew limit applies per sample, so new commands in a burst of calls could have any acceleration."""
    driver, base = controller(), robot()
    results, _, _ = drive(driver, base, REFERENCE, 0.2)
    for k in range(8):
        repeated = driver.step(base.time - DT + k * 0.001, base.measure())
        assert repeated.mode is Mode.TRACKING
        assert (repeated.command == results[-1].command).all()
        assert "repeated" in repeated.message


@pytest.mark.parametrize(("leap", "mode"), [(0.5, "STOPPED"), (1e6, "STOPPED"), (-1.0, "BRAKING"), (np.nan, "BRAKING")])
def test_only_a_forward_leap_of_the_clock_zeroes_the_command_at_once(leap, mode):
    driver, base = controller(), robot()
    last_command = drive(driver, base, REFERENCE, 2.0)[0][-1].command
    assert (np.abs(last_command) > SLEW).any()
    result = driver.step(base.time + leap, base.measure())
    assert result.mode == mode
    assert (result.command == (0.0 if mode == "STOPPED" else last_command - np.clip(last_command, -SLEW, SLEW))).all()
    # A leap far beyond the receipt of the measurements is a glitch of one tick.
    assert leap != 1e6 or driver.step(base.time, base.measure()).mode is Mode.TRACKING


def test_robot_waits_after_a_leap_of_the_clock_and_continues_from_rest_on_resume():
    driver, base = controller(**{"failure.max_position_error": 100.0}), robot()
    drive(driver, base, REFERENCE, 2.0)
    resting = IdealRobot(load_model("ssm").discretise(DT), base.pose)
    results = []
    for k in range(20):
        m = resting.measure()
        t = base.time + 5.0 + k * DT
        m = Measurement(pose=Stamped(m.pose.value, t), wheel_twist=Stamped([0.0, 0.0], t), yaw_rate=Stamped(0.0, t))
        results.append(driver.step(t, m))
        if k == 9:
            assert driver.is_latched
            driver.resume()
    assert "no tick for" in results[0].message
    assert not np.any([r.command for r in results[:10]])
    assert "stopped after a failure (no tick for 5.04 s; the estimate restarts)" in results[9].message
    assert results[-1].mode is Mode.TRACKING
    commands = np.array([r.command for r in results[1:]])
    assert (np.abs(np.diff(commands, axis=0)) <= SLEW + 1e-9).all()


@pytest.mark.parametrize("error", [[0.8, 0.0, 0.0], [0.0, 0.0, 3.0]])
def test_wrong_first_pose_is_detected_before_the_robot_moves_far(error):
    wrong_pose = bad_poses(0, value=REFERENCE.sample([0.0]).pose[0] + error)
    results, poses, times = drive(controller(), robot(), REFERENCE, 6.0, change=wrong_pose)
    # The robot brakes after two more poses, which agree: no command exceeds three ticks of slew.
    assert modes(results[:8]) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert np.abs([r.command[0] for r in results[:6]]).max() <= 3 * SLEW[0] + 1e-9
    assert results[-1].mode is Mode.TRACKING
    assert np.abs((poses - REFERENCE.sample(times).pose)[-50:, :2]).max() < 0.01


def test_reported_command_beyond_limits_does_not_extend_them():
    driver, base = controller(), robot()
    drive(driver, base, REFERENCE, 2.0)
    for reported in [(4.9, 9.0), (-4.9, -9.0), (1e307, 0.0), ("a", "b"), (None, 1.0), [[1.0], [2.0, 3.0]]]:
        result = driver.step(base.time, replace(base.measure(), sent=reported))
        assert (np.abs(result.command) <= [1.5, 2.0]).all()
        base.advance(result.command)


def test_plan_is_not_reused_beyond_its_horizon():
    reference = CorruptedReference(REFERENCE)

    def corrupt(k, m):
        reference.is_corrupted = k >= 60
        return m

    results, _, _ = drive(
        controller(horizon=3, **{"failure.max_reused_ticks": 50}), robot(), reference, 1.6, change=corrupt
    )
    assert sum(r.mode is Mode.REUSED_PLAN for r in results) == 2


every_backend = pytest.mark.parametrize("backend", BACKENDS)


@every_backend
def test_failed_solve_reuses_the_last_plan(monkeypatch, backend):
    solver = FailingSolver(monkeypatch)
    results, _, _ = drive(controller(**BACKENDS[backend]), robot(), REFERENCE, 4.0, change=solver.during({100, 101}))
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.TRACKING]
    assert results[100].command == pytest.approx(results[99].planned_commands[1], abs=1e-6)
    assert results[101].command == pytest.approx(results[99].planned_commands[2], abs=1e-6)
    assert "iteration limit" in results[100].message
    assert results[100].solver.status is SolverStatus.MAX_ITERATIONS


@every_backend
def test_lasting_solver_failure_leads_through_every_mode_and_recovers(monkeypatch, backend):
    solver = FailingSolver(monkeypatch, "infeasible")
    ticks = set(range(100, 180))
    results, _, _ = drive(controller(**BACKENDS[backend]), robot(), REFERENCE, 6.0, change=solver.during(ticks))
    assert modes(results) == [Mode.TRACKING, Mode.REUSED_PLAN, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    assert sum(r.mode is Mode.REUSED_PLAN for r in results) == 5
    assert (slews(results) <= SLEW + 1e-12).all()


@every_backend
def test_solve_that_ends_at_its_time_limit_counts_as_missed(monkeypatch, backend):
    solver = FailingSolver(monkeypatch, "time limit")
    results, _, _ = drive(controller(**BACKENDS[backend]), robot(), REFERENCE, 1.5, change=solver.during({60}))
    assert [result.solver.missed for result in results[59:62]] == [0, 1, 0]


@every_backend
def test_nonfinite_plan_is_not_executed(monkeypatch, backend):
    solver = FailingSolver(monkeypatch, "solved", garbage=math.nan)
    results, _, _ = drive(controller(**BACKENDS[backend]), robot(), REFERENCE, 3.0, change=solver.during({100}))
    assert results[100].mode is Mode.REUSED_PLAN
    assert np.isfinite([r.command for r in results]).all()


@every_backend
def test_failed_warm_start_is_discarded(monkeypatch, backend):
    """After a failed solve the solver starts cold, so that the state of the failed solve has no effect."""
    solver = FailingSolver(monkeypatch, garbage=1e12)
    results, _, _ = drive(controller(**BACKENDS[backend]), robot(), REFERENCE, 2.0, change=solver.during({50}))
    assert [r.solver.status.usable for r in results].count(False) == 1
    assert solver.solves >= len(results) - 5, "the backend must be called at nearly every tick"


TEN_ITERATIONS = {
    "osqp": {"solver.osqp.max_iter": 10, "solver.osqp.eps_abs": 1e-9, "solver.osqp.eps_rel": 1e-9},
    "daqp": {"solver.max_iterations": 10, "solver.tolerance": 1e-9},
}


@every_backend
def test_plan_stopped_at_the_iteration_limit_is_not_executed(backend):
    limited = controller(**BACKENDS[backend] | TEN_ITERATIONS[backend])
    results, _, _ = drive(limited, robot(), REFERENCE, 1.0)
    failed = [r for r in results if r.solver.status is SolverStatus.MAX_ITERATIONS]
    assert failed
    assert not any(r.mode is Mode.TRACKING for r in failed)


BRAKE = {"limits.v_braking": 0.7, "limits.omega_braking": 1.1}


@pytest.mark.parametrize("slew", [{"limits.v_slew": 0.001, "limits.omega_slew": 0.001}, {}])
def test_braking_uses_its_limits_for_any_slew(slew):
    """Without sensors the robot stops at the braking limits, although a tiny slew was set during the drive."""
    driver, base = controller(**BRAKE), robot()
    drive(driver, base, REFERENCE, 3.0)
    driver.update(limits={key.partition(".")[2]: value for key, value in slew.items()})
    results = []
    for _ in range(200):
        results.append(driver.step(base.time, Measurement()))
        base.advance(results[-1].command)
    assert modes(results) == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED]
    braking = [k for k, r in enumerate(results) if r.mode is Mode.BRAKING]
    commands = np.array([r.command for r in results])
    speed = np.abs(commands[braking[0] - 1])
    assert speed.min() > 0.4
    # Each channel brakes at a constant rate until it is at rest.
    for channel, rate in enumerate((0.7, 1.1)):
        expected = np.maximum(speed[channel] - rate * DT * np.arange(1, len(braking) + 2), 0.0)
        assert np.abs(commands[braking[0] : braking[-1] + 2, channel]) == pytest.approx(expected, abs=1e-12)


def test_hold_and_finish_decelerate_at_the_braking_limits():
    driver, base = controller(**BRAKE), robot()
    drive(driver, base, REFERENCE, 2.0)
    holding = [driver.step(base.time + k * DT, Measurement(), Hold("pause")) for k in range(3)]
    assert modes(holding) == [Mode.BRAKING]
    assert slews(holding) == pytest.approx(np.tile([0.7, 1.1], (2, 1)) * DT, abs=1e-12)
    cane = load_trajectory("cane")
    # The finish tolerance is so large that the robot reaches it at full speed.
    driver = controller(**BRAKE | {"finish.position": 5.0, "finish.speed": 5.0, "weights.v": 2000.0})
    results, _, _ = drive(driver, IdealRobot(load_model("ssm").discretise(DT), np.zeros(3)), cane, cane.duration + 1.0)
    finished = [r.mode for r in results].index(Mode.FINISHED)
    ramp = np.abs([r.command for r in results[finished - 1 :]])
    assert (ramp[:-1] - ramp[1:] <= np.array([0.7, 1.1]) * DT + 1e-12).all()
    assert not ramp[-1].any()
