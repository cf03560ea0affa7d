"""External speed limit: the robot respects the limit on its path, the reference waits, and the limit can be removed."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc.ros.reference_input import MIN_SPEED_LIMIT, SpeedLimit
from diffdrive_mpc.mpc.step_result import Mode

CONFIG = load_config("ssm")
DT = CONFIG.sample_time
SLEW = np.array([CONFIG.limits.v_slew, CONFIG.limits.omega_slew]) * DT + 1e-9


def drive(controller, plant, reference, ticks, limits):
    """Drive with limits (tick: speed); return commands, true speeds, distances from the path, and results by tick."""
    path = reference.sample(np.linspace(0.0, reference.duration, 4000)).pose[:, :2]
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, 0.0)
    commands, speeds, distance, steps = [], [], [], []
    for tick in range(ticks):
        if tick in limits:
            controller.limit_speed(limits[tick])
        step = controller.step(tick * DT, plant.measure())
        previous_pose = plant.true_pose
        plant.advance(step.command)
        commands.append(step.command)
        speeds.append(math.hypot(*(plant.true_pose - previous_pose)[:2]) / DT)
        distance.append(np.hypot(*(path - plant.true_pose[:2]).T).min())
        steps.append(step)
    return np.array(commands), np.array(speeds), np.array(distance), steps


@pytest.mark.parametrize(
    ("plant", "sensors", "excess", "bound"),
    [("model:ssm+0.005", "perfect", 0.002, 0.01), ("mujoco", "default", 0.01, 0.02)],
)
@pytest.mark.parametrize("trajectory", ["circle", "s"])
def test_robot_respects_the_speed_limit_on_a_curve_until_it_is_removed(trajectory, plant, sensors, excess, bound):
    limit, reference = 0.25, load_trajectory(trajectory)
    robot = make_plant(plant, surface="ideal" if sensors == "perfect" else "default", sensors=sensors, seed=3)
    controller = Controller(CONFIG)
    commands, speeds, distance, steps = drive(controller, robot, reference, 700, {100: limit, 400: None})
    initial_speed = commands[99, 0]
    assert initial_speed > 1.5 * limit
    assert (np.abs(np.diff(commands, axis=0)) <= SLEW).all()
    # The command reaches the limit as fast as the slew permits; the robot follows within its lag.
    reached = 100 + math.ceil((initial_speed - limit) / SLEW[0])
    assert (np.abs(commands[reached:400, 0]) <= limit + 1e-9).all()
    zone = slice(reached + round(0.5 / DT), 400)
    assert speeds[zone].max() <= limit + excess
    assert np.median(speeds[zone]) > 0.85 * limit
    assert distance.max() <= bound
    assert all(step.mode is Mode.TRACKING for step in steps[:400])
    # The reference waits, so the robot does not need a return path.
    assert not any("rejoining" in step.message for step in steps)
    assert "limited to 0.25 m/s" in steps[300].message
    assert steps[399].reference_delay > 0.3 * (400 - reached) * DT
    assert speeds[450:600].max() > initial_speed
    assert "limited" not in steps[-1].message


def test_slower_reference_is_not_affected():
    reference = load_trajectory("circle")
    runs = []
    for limits in ({}, {50: 1.0}):
        plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
        runs.append(drive(Controller(CONFIG), plant, reference, 200, limits)[0])
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_configuration_keeps_its_own_limits_and_updates_keep_the_speed_limit():
    controller = Controller(CONFIG)
    controller.limit_speed(0.2)
    plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
    reference = load_trajectory("circle")
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, 0.0)
    for tick in range(200):
        if tick == 60:
            assert controller.update(weights={"across": 250.0}, limits={"v": 1.2}).limits.v == 1.2
        step = controller.step(tick * DT, plant.measure())
        assert abs(step.command[0]) <= 0.2 + 1e-9
        plant.advance(step.command)
    assert controller.config.limits.v == 1.2
    assert controller.speed_limit == 0.2
    assert pickle.loads(pickle.dumps(controller)).speed_limit == 0.2


def test_only_the_command_is_limited_without_reentry():
    config = CONFIG.model_copy(update={"reentry": CONFIG.reentry.model_copy(update={"enabled": False})})
    plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
    commands, _, _, steps = drive(Controller(config), plant, load_trajectory("circle"), 200, {60: 0.2})
    assert (np.abs(commands[100:, 0]) <= 0.2 + 1e-9).all()
    assert steps[-1].reference_delay == 0.0


@given(value=st.floats(0.0, 1e6), percentage=st.booleans(), max_speed=st.floats(0.05, 5.0))
def test_speed_limit_is_none_or_between_the_minimum_and_the_maximum_speed(value, percentage, max_speed):
    result = SpeedLimit(value, percentage).speed(max_speed)
    if value == 0.0:
        assert result is None
    else:
        assert MIN_SPEED_LIMIT <= result <= max_speed
        requested = value * max_speed / 100 if percentage else value
        assert result == pytest.approx(min(max(requested, MIN_SPEED_LIMIT), max_speed))
