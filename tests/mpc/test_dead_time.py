"""The dead time is learned while driving: right, certain, within bounds, and only where there is something to learn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot, drive

from diffdrive_mpc import Controller, Measurement, Stamped, load_config, load_model
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.features.online_dead_time import DeadTimeEstimator
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments

DT = 0.0202
SM = load_model("sm")


def path(*twists):
    segments = [Segment(v=v, omega=omega, duration=seconds) for v, omega, seconds in twists]
    return lay_segments(segments, TrajectoryLimits.of_robot(), name="path")


BENDS = path(*[(0.5, 0.8, 1.0), (0.3, -0.8, 1.0)] * 12)
STRAIGHT = path((0.5, 0.0, 12.0))


def controller(model="sm", given=None, lag=0.0, **settings):
    values = PROMPT | {
        "sensors.wheels.lag": lag,
        "online_dead_time.enabled": True,
        **{f"online_dead_time.{key}": value for key, value in settings.items()},
    }
    return Controller(replace_values(load_config(model), values), model=given)


def driven(by, shift=(0.0, 0.0), *, reference=BENDS, seconds=8.0, noise=1.0, change=None, robot=SM):
    """Drive a robot whose dead time differs by `shift` [s]; returns results and errors of the position (n, 2) [m]."""
    other = replace(robot, dead_time=robot.dead_time + np.array(shift)).discretise(DT)
    plant = IdealRobot(other, reference.sample([0.0]).pose[0], noise=noise)
    results, poses, times = drive(by, plant, reference, seconds, change=change)
    return results, (poses - reference.sample(times).pose)[:, :2]


def commands(results):
    return np.array([result.command for result in results])


@pytest.mark.parametrize("shift", [(0.06, 0.06), (0.033, -0.02), (-0.03, 0.0), (0.0, 0.0)])
def test_known_dead_time_is_estimated_and_used(shift):
    found = driven(controller(), shift)[0][-1].dead_time
    truth = SM.dead_time + shift
    np.testing.assert_allclose(found.value, truth, atol=0.010)
    assert np.all(np.abs(found.value - truth) < 4 * found.deviation)
    assert np.all(found.deviation < 0.010)
    np.testing.assert_allclose(found.used, truth, atol=0.015)


def test_late_wheel_readings_do_not_change_the_dead_time():
    """The stamp counts, not the time of receipt; and a lag that is stated comes on top of it."""
    pending = []

    def late(_, measurement):
        pending.append(measurement.wheel_twist)
        value, time = pending[max(len(pending) - 3, 0)].value, pending[max(len(pending) - 2, 0)].time
        return replace(measurement, wheel_twist=Stamped(value, time))

    estimate = driven(controller(lag=DT), (0.03, 0.03), change=late)[0][-1].dead_time
    np.testing.assert_allclose(estimate.value, SM.dead_time + 0.03, atol=0.010)


def test_gyro_alone_gives_the_dead_time_of_omega():
    def blind(_, measurement):
        return replace(measurement, wheel_twist=None)

    estimate = driven(controller(), (0.06, 0.04), change=blind)[0][-1].dead_time
    assert np.isnan(estimate.value[0])
    assert estimate.value[1] == pytest.approx(SM.dead_time[1] + 0.04, abs=0.010)


def test_learned_dead_time_gives_the_error_of_the_true_one():
    shift = np.array([0.06, 0.06])
    right = replace(SM, dead_time=SM.dead_time + shift)
    by = {
        "right": Controller(load_config("sm", PROMPT), model=right),
        "wrong": Controller(load_config("sm", PROMPT)),
        "online": controller(),
    }
    error = {}
    for name, one in by.items():
        later = driven(one, shift, seconds=24.0)[1][round(20.0 / DT) :]
        error[name] = np.sqrt(np.mean(np.sum(later**2, axis=1)))
    assert error["wrong"] > 1.3 * error["right"]
    assert error["online"] < 1.3 * error["right"]


def test_estimate_is_frozen_without_excitation():
    results, _ = driven(controller(), (0.06, 0.06), reference=STRAIGHT, seconds=10.0)
    at_speed, later = results[round(3.0 / DT)].dead_time, results[-1].dead_time
    assert at_speed.value[0] == pytest.approx(SM.dead_time[0] + 0.06, abs=0.010)
    np.testing.assert_array_equal(later.value[0], at_speed.value[0])
    # It never turned.
    assert np.isnan(later.value[1])
    assert later.used[1] == SM.dead_time[1]


@pytest.mark.parametrize(("shift", "bounds"), [((0.15, 0.15), (0.06, 0.05)), ((-0.03, -0.03), (0.01, 0.05))])
def test_used_dead_time_stays_within_its_bounds(shift, bounds):
    results, _ = driven(controller(shorter=bounds[0], longer=bounds[1]), shift)
    wanted = SM.dead_time + np.clip(shift, -bounds[0], bounds[1])
    for result in results:
        assert np.all(result.dead_time.used <= SM.dead_time + bounds[1] + 1e-12)
        assert np.all(result.dead_time.used >= SM.dead_time - bounds[0] - 1e-12)
    np.testing.assert_allclose(results[-1].dead_time.used, wanted, atol=0.011)


def test_used_dead_time_is_never_negative():
    slow = load_model("ssm").with_extra_dead_time([0.02, 0.02])
    found = driven(controller(given=slow, longer=0.0), (-0.02, -0.02), robot=slow)[0][-1].dead_time
    assert np.all(found.used >= 0.0)
    assert np.all(found.used < 0.012)


def test_dead_time_changes_in_steps_without_jumps_of_the_command():
    by, constants = controller(), fixed_values()
    results, _ = driven(by, (0.06, 0.06))
    used = np.array([result.dead_time.used for result in results])
    changed = np.flatnonzero(np.diff(used, axis=0).any(axis=1))
    assert len(changed) >= 3
    assert np.abs(np.diff(used, axis=0)).max() <= constants["online_dead_time.step"] + 1e-12
    assert np.diff(changed).min() * DT >= constants["online_dead_time.pause"] - DT
    limits = by.config.limits
    moves = np.abs(np.diff(commands(results), axis=0))
    assert np.all(moves <= np.array([limits.v_slew, limits.omega_slew]) * DT + 1e-9)
    # At a change no more than at others.
    assert np.all(moves[changed].max(axis=0) <= np.quantile(moves, 0.99, axis=0) + 1e-9)


def test_estimate_that_is_not_applied_changes_no_command():
    plain = driven(Controller(load_config("sm", PROMPT)), (0.06, 0.06))[0]
    assert plain[-1].dead_time is None
    told = driven(controller(apply=False), (0.06, 0.06))[0]
    assert np.array_equal(commands(plain), commands(told))
    advice = [result.message for result in told if "looks" in result.message]
    assert sum("dead time of v looks" in text for text in advice) == 1
    assert sum("set" in text or "extra_dead_time.omega" in text for text in advice) == 1
    right = driven(controller(apply=False))[0]
    assert not any("looks" in result.message for result in right)


def learner(seconds=6.0, **said):
    """Return an estimate from a robot's exact responses, with results that contain `said`."""
    by, robot = DeadTimeEstimator(controller().config, SM), SM.with_extra_dead_time([0.05, 0.05]).discretise(DT)
    given = 0.4 * np.sin(np.arange(round(seconds / DT))[:, None] * DT * [2.0, 3.0])
    for k, (command, twist) in enumerate(zip(given, robot.simulate(given), strict=True)):
        fine = {"mode": Mode.TRACKING, "blocked_for": 0.0, "unused_sensors": ()}
        result = SimpleNamespace(command=command, **{**fine, **said})
        by.take(k * DT, Measurement(wheel_twist=Stamped(twist, k * DT)), result)
    return by.found


@pytest.mark.parametrize(
    "said",
    [{"mode": Mode.BRAKING}, {"mode": Mode.STOPPED}, {"blocked_for": 0.2}, {"unused_sensors": ("wheel speed",)}],
    ids=str,
)
def test_held_robot_and_accused_sensors_do_not_change_the_estimate(said):
    assert np.isnan(learner(**said).value).all()


@pytest.mark.parametrize("sent", [(1e300, -1e300), (np.inf, 0.0), (np.nan, 0.0)])
def test_impossible_reported_commands_do_not_change_the_estimate(sent):
    """Warnings are errors here."""

    def spoil(k, m):
        return replace(m, sent=sent) if k % 50 == 40 else m

    plain, spoilt = (driven(controller(), change=change)[0] for change in (None, spoil))
    assert spoilt[-1].dead_time.value == pytest.approx(plain[-1].dead_time.value, abs=0.005)


def test_pause_does_not_change_the_estimate():
    by = controller()
    driven(by, (0.04, 0.04), seconds=6.0)
    before = by.step(6.0, Measurement(), Hold("pause")).dead_time
    results, _ = driven(by, (0.04, 0.04), seconds=6.0)
    np.testing.assert_allclose(results[-1].dead_time.value, SM.dead_time + 0.04, atol=0.010)
    np.testing.assert_allclose(before.value, results[-1].dead_time.value, atol=0.005)


def test_estimation_without_compensation_raises_error():
    with pytest.raises(ValueError, match="compensation.dead_time"):
        Controller(load_config("sm", {"online_dead_time.enabled": True, "compensation.dead_time": False}))


def test_delay_beyond_the_memory_raises_error():
    by = Controller(load_config("sm", PROMPT))
    tick, problem = by._tick, by._problem(by.config, by._predicted)
    prepared = tick.prepare(problem.constants())
    with pytest.raises(ValueError, match="larger than at first"):
        tick.configure(prepared, problem.sizes | {"delay_v": problem.sizes["window"]})
    with pytest.raises(ValueError, match="larger than at first"):
        tick.configure(prepared, problem.sizes | {"lag_omega": 40})
