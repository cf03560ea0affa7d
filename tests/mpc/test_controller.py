"""The controller on a robot that equals its model: accuracy, slip, clock offsets, updates and reproducibility."""

import copy
import os
import subprocess
import sys
import warnings
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot, drive

from diffdrive_mpc import ConfigError, Measurement, Stamped, Trajectory, load_model
from diffdrive_mpc.mpc import Controller, Mode, load_config, load_trajectory
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments

DT = 0.0202
MODEL = load_model("ssm")


def robot_for(reference, **kwargs):
    return IdealRobot(MODEL.discretise(DT), reference.sample([0.0]).pose[0], **kwargs)


# Settings tuned for the mujoco plant; the robots of these tests have no encoder lag, and most have no slip.
SLIP_KEYS = ("estimator.side_slip", "estimator.load_shift")


def controller(**overrides):
    return Controller(load_config("ssm", PROMPT | dict.fromkeys(SLIP_KEYS, 0.0) | overrides))


def rmse(poses, times, reference):
    error = poses - reference.sample(times).pose
    return np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))), np.abs(error[:, 2]).max()


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_exact_model_is_tracked_within_millimetres(name):
    reference = load_trajectory(name)
    results, poses, times = drive(controller(), robot_for(reference), reference, reference.duration)
    position, heading = rmse(poses, times, reference)
    assert {result.mode for result in results} == {Mode.TRACKING}
    assert all(result.solver.status is SolverStatus.SOLVED for result in results)
    assert position < 0.003
    assert heading < 0.05


def test_constant_slip_leaves_no_steady_error():
    reference = load_trajectory("circle")
    slip = Slip(v_offset=-0.03, longitudinal_gain=0.98, yaw_gain=0.8, side_slip=0.06)
    robot = robot_for(reference, slip=slip)
    _, poses, times = drive(controller(), robot, reference, reference.duration)
    x, y, theta = reference.sample(times).pose[300:500].T
    lateral_error = np.cos(theta) * (poses[300:500, 1] - y) - np.sin(theta) * (poses[300:500, 0] - x)
    assert np.abs(lateral_error).max() < 0.003
    # The heading that compensates side slip must not cause an error along the path.
    longitudinal_error = np.cos(theta) * (poses[300:500, 0] - x) + np.sin(theta) * (poses[300:500, 1] - y)
    assert longitudinal_error == pytest.approx(0.0, abs=0.002)
    assert poses[300:500, 2] - theta == pytest.approx(np.arctan(0.06 * 0.5), abs=0.004)


def two_speed_curves():
    """Return curves to both sides, each at two speeds."""
    twists = [(0.8, 0.8), (0.3, 0.8), (0.9, -0.8), (0.3, -0.8)] * 4
    segments = [Segment(v=v, omega=omega, duration=1.2) for v, omega in twists]
    return time_segments(segments, TrajectoryLimits.of_robot(), name="hurried")


def compare_side_slip(first_share=0.5, noise=1.0, slip=None, **settings):
    """Return the errors with (True) and without (False) compensation of side slip, and the final estimate with it.

    Errors count after the first `first_share` of the drive.
    """
    reference, errors, estimates = two_speed_curves(), {}, {}
    for is_enabled in (True, False):
        driver = controller(**{"compensation.side_slip": is_enabled} | settings)
        robot = robot_for(reference, slip=slip, noise=noise)
        results, poses, times = drive(driver, robot, reference, reference.duration)
        first = int(first_share * len(times))
        errors[is_enabled] = rmse(poses[first:], times[first:], reference)[0]
        estimates[is_enabled] = results[-1].estimate
    return errors, estimates[True]


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(
    ("slip", "min_ratio"),
    [(Slip(turn_ahead=0.05), 4), (Slip(turn_left=0.05), 3.5), (Slip(side_slip=0.06, load_shift=0.05), 3.5)],
    ids=["ahead", "left", "dips"],
)
def test_robot_with_a_displaced_turning_point_is_tracked(slip, min_ratio, noise):
    """After learning, errors are millimetres, and each slip is within three standard deviations of its true value."""
    errors, estimate = compare_side_slip(slip=slip, noise=noise)
    error = np.abs(np.subtract(astuple(estimate.slip), astuple(slip)))
    assert (error < 3 * np.array(astuple(estimate.slip_deviation)) + 1e-6).all()
    assert errors[True] < 0.007
    assert errors[False] > min_ratio * errors[True]


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_robot_that_slides_while_turning_is_tracked(noise):
    slip = Slip(slide_x=0.1, slide_y=-0.05)
    errors, estimate = compare_side_slip(slip=slip, noise=noise)
    for name in ("slide_x", "slide_y"):
        error = abs(getattr(estimate.slip, name) - getattr(slip, name))
        assert error < min(3 * getattr(estimate.slip_deviation, name), 0.03)
    assert errors[True] < 0.5 * errors[False]


@pytest.mark.parametrize("prior", [0.0, 0.06])
def test_slip_estimation_does_not_increase_errors_without_slip(prior):
    """The prior is wrong for this robot: errors count after learning."""
    priors = {"estimator.side_slip": prior, "estimator.load_shift": prior}
    errors, _ = compare_side_slip(first_share=0.5 if prior else 0.0, **priors)
    assert errors[True] < errors[False] + 0.0005


@pytest.mark.parametrize("turns", [-2, 1, 3])
def test_full_turns_of_the_start_heading_do_not_change_commands(turns):
    reference = load_trajectory("circle")
    expected, _, _ = drive(controller(), robot_for(reference), reference, 3.0)
    robot = IdealRobot(MODEL.discretise(DT), reference.sample([0.0]).pose[0] + [0, 0, 2 * np.pi * turns])
    actual, _, _ = drive(controller(), robot, reference, 3.0)
    assert np.array([r.command for r in actual]) == pytest.approx(np.array([r.command for r in expected]), abs=1e-6)


def test_start_time_of_the_clock_does_not_change_commands():
    reference = load_trajectory("cane")
    at_zero, _, _ = drive(controller(), robot_for(reference), reference, 2.0)
    robot = robot_for(reference)
    shifted = controller()
    robot.k = 5000
    shifted_results, _, _ = drive(shifted, robot, reference, 2.0, t0=robot.time)
    assert np.array([r.command for r in shifted_results]) == pytest.approx(
        np.array([r.command for r in at_zero]), abs=1e-7
    )


@pytest.mark.parametrize(
    ("t0", "step_times", "message"),
    [
        (1.7e9, [0.0], "the reference begins in 1.7e+09 s, at t0: start and step need the same clock"),
        (0.0, [1.7e9], "the reference ended 1.7e+09 s before the first step: give start a t0 on the clock of step"),
        (0.0, [0.0, 1e3 * DT], "1000 sample times: give step its t in seconds"),
    ],
)
def test_robot_that_does_not_drive_because_of_two_clocks_says_so(t0, step_times, message):
    driver, reference = controller(), load_trajectory("circle")
    driver.start(reference, t0)
    results = [driver.step(t, Measurement(Stamped(reference.sample([0.0]).pose[0], t))) for t in step_times]
    assert message in results[-1].message
    assert (results[-1].command == 0.0).all()


def test_repeated_runs_and_runs_after_reset_are_bit_identical():
    reference, reused, runs = load_trajectory("s"), controller(), []
    for driver in (reused, controller(), reused):
        driver.reset()
        runs.append(drive(driver, robot_for(reference, noise=1.0, late=2), reference, 4.0)[0])
    for repeated in runs[1:]:
        assert all((a.command == b.command).all() for a, b in zip(runs[0], repeated, strict=True))


def test_configured_dead_time_is_compensated():
    """A robot with 150 ms of extra dead time has small errors if the configuration contains the dead time."""
    reference, late_model = load_trajectory("s"), MODEL.with_extra_dead_time([0.15, 0.15])
    errors = {}
    for extra in (0.0, 0.15):
        robot = IdealRobot(late_model.discretise(DT), reference.sample([0.0]).pose[0])
        mpc = controller(**{"extra_dead_time.v": extra, "extra_dead_time.omega": extra, "compensation.delay": False})
        _, poses, times = drive(mpc, robot, reference, reference.duration)
        # The start is excluded, because the first command is delayed in both cases.
        errors[extra] = rmse(poses[100:], times[100:], reference)[0]
    assert errors[0.15] < 0.003
    assert errors[0.15] < 0.6 * errors[0.0]


def test_drive_finishes_at_rest_at_the_end():
    reference = load_trajectory("cane")
    results, poses, _ = drive(controller(), robot_for(reference, noise=1.0), reference, reference.duration + 3.0)
    assert results[-1].mode is Mode.FINISHED
    assert (results[-1].command == 0).all()
    assert np.hypot(*(poses[-1] - reference.sample([reference.duration]).pose[0])[:2]) < 0.03


def test_restart_while_driving_keeps_slew_limit_and_twist_estimate():
    circle, robot, driver = load_trajectory("circle"), robot_for(load_trajectory("circle")), controller()
    results, _, _ = drive(driver, robot, circle, 2.0)
    driver.start(circle, robot.time - 2.0)
    result = driver.step(robot.time, robot.measure())
    assert (np.abs(result.command - results[-1].command) <= np.array([2.0, 6.0]) * DT + 1e-9).all()
    assert result.estimate.twist == pytest.approx(robot.twist, abs=1e-3)


def test_reported_command_replaces_the_sent_command_in_the_estimate():
    """The base halves every command; the estimator needs no offset if it receives the halved commands."""
    reference, offsets = load_trajectory("circle"), {}
    for is_reported in (False, True):
        robot, driver, applied = robot_for(reference), controller(), None
        driver.start(reference, 0.0)
        for _ in range(60):
            measurement = robot.measure()
            if is_reported and applied is not None:
                measurement = replace(measurement, sent=tuple(applied))
            result = driver.step(robot.time, measurement)
            applied = 0.5 * result.command
            robot.advance(applied)
        offsets[is_reported] = abs(result.estimate.slip.v_offset)
    assert offsets[True] < 1e-6
    assert offsets[False] > 0.01


def test_estimate_follows_commands_of_another_controller():
    """Another controller drives the robot at 0.3 m/s; the estimate follows its commands."""
    robot, observer = robot_for(load_trajectory("circle")), controller()
    observer.start(load_trajectory("circle"), robot.time)
    for _ in range(150):
        result = observer.step(robot.time, robot.measure())
        observer.set_applied_commands([[0.3, 0.1]])
        robot.advance(np.array([0.3, 0.1]))
    assert result.estimate.twist == pytest.approx([0.3, 0.1], abs=0.02)
    # The slew limit is relative to the applied command, not to the proposed command of this controller.
    limits = observer.config.limits
    steps = np.array([limits.v_slew, limits.omega_slew]) * DT
    assert (np.abs(result.command - [0.3, 0.1]) <= steps + 1e-12).all()
    # The core ignores commands that are not finite.
    observer._tick.set_applied_commands([[0.5, np.nan]])
    assert observer._tick.last_command.tolist() == [0.3, 0.1]


def test_updates_take_effect_between_two_ticks():
    reference, robot, driver = load_trajectory("circle"), None, controller()
    robot = robot_for(reference)
    driver.start(reference, 0.0)
    commands = []
    for k in range(150):
        if k == 100:
            with pytest.warns(UserWarning, match=r"lag behind .* reference 'circle': v = 0.5 at .* limits.v = 0.2"):
                new_config = driver.update(limits={"v": 0.2})
            assert new_config.limits.v == 0.2
            assert driver.config.limits.v == 1.5
        result = driver.step(robot.time, robot.measure())
        commands.append(result.command)
        robot.advance(result.command)
    commands = np.array(commands)
    # The limit is below the current command, which approaches it at the slew limit.
    assert commands[99, 0] > 0.45
    assert (np.abs(np.diff(commands, axis=0)) <= np.array([2.0, 6.0]) * DT + 1e-12).all()
    upper = np.maximum(commands[99, 0] - 2.0 * DT * np.arange(1, 51), 0.2)
    assert (commands[100:, 0] <= upper + 1e-9).all()
    assert commands[-1, 0] == pytest.approx(0.2, abs=1e-3)
    assert driver.config.limits.v == 0.2


def test_copy_during_a_drive_warns_that_it_starts_anew():
    driver = controller()
    driver.start("circle", 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copy.copy(driver)
    driver.step(0.0, Measurement())
    with pytest.warns(UserWarning, match="a copy of a controller starts its drive anew"):
        copy.deepcopy(driver)


def test_update_warns_only_if_the_rest_of_the_reference_exceeds_the_limits():
    """The reference has 1 m/s in the first second, then 0.3 m/s."""
    times = np.linspace(0.0, 6.0, 301)
    v = np.where(times < 1.0, 1.0, 0.3)
    reference = Trajectory.from_arrays(times, np.concatenate([[0.0], np.cumsum(v[:-1] * 0.02)]), 0.0 * times, v=v)
    for instant, is_exceeded in ((0.5, True), (3.0, False)):
        driver, robot = controller(), robot_for(reference)
        driver.start(reference, 0.0)
        while robot.time < instant:
            robot.advance(driver.step(robot.time, robot.measure()).command)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            driver.update(limits={"v": 0.5})
        assert bool(warned) == is_exceeded


@pytest.mark.parametrize(
    "change", [{"limits": {"v": -1.0}}, {"limits": {"speed": 1.0}}, {"weights": {"across": float("nan")}}]
)
def test_rejected_update_changes_nothing(change):
    driver = controller()
    config = driver.config
    with pytest.raises(ConfigError):
        driver.update(**change)
    assert driver.config is config


@pytest.mark.parametrize("steps", [1.8, 2.0])
def test_error_for_a_horizon_within_the_dead_time_contains_the_minimum(steps):
    dead_time = {"extra_dead_time.v": steps * DT}
    message = (
        "horizon = 2: the horizon ends within the dead time of the model, 2 steps of 0.0202 s; set horizon to 3 or more"
    )
    with pytest.raises(ValueError, match=message):
        controller(horizon=2, **dead_time)
    assert controller(horizon=3, **dead_time).config.horizon == 3
    assert controller(horizon=1).config.horizon == 1
    # SM responds within its third sample, so three steps are enough.
    assert Controller(load_config("sm", {"horizon": 3})).config.horizon == 3


DRIVES_OF_EVERY_ORDER = """
import numpy as np
from ideal_robot import IdealRobot, drive
from diffdrive_mpc.models import VelocityModel
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory

config, reference = load_config("ssm", {"horizon": 12}), load_trajectory("s")
for order in range(2, 10):
    # v has a chain of lags, omega a single lag.
    rates = np.linspace(30.0, 60.0, order)
    A = np.diag(-rates) + np.diag(np.append(rates[1:-1], 0.0), k=-1)
    B, C = np.zeros((order, 2)), np.zeros((2, order))
    B[0, 0], B[-1, 1], C[0, -2], C[1, -1] = rates[0], rates[-1], 1.0, 1.0
    model = VelocityModel("chain", "sm", A, B, C)
    robot = IdealRobot(model.discretise(config.sample_time), reference.sample([0.0]).pose[0], noise=1.0)
    results, poses, times = drive(Controller(config, model), robot, reference, 30.5 * config.sample_time)
    assert {str(result.mode) for result in results} == {"TRACKING"} and len(results) == 30
    assert np.linalg.norm((poses - reference.sample(times).pose)[-1, :2]) < 0.05
    print(order)
"""


def test_compiled_core_drives_models_of_every_order():
    """A separate process drives the models, because misaligned rows of the filter state would crash it.

    The minimum is two states, one per channel.
    """
    folder = Path(__file__).parent
    path = os.pathsep.join([str(folder), str(folder.parent), *filter(None, sys.path)])
    process = subprocess.run(
        [sys.executable, "-c", DRIVES_OF_EVERY_ORDER],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        check=False,
    )
    assert process.returncode == 0, f"after {process.stdout.split()}: {process.stderr[-2000:]}"
    assert process.stdout.split() == [str(order) for order in range(2, 10)]
