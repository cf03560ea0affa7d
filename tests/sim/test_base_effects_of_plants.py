"""Effects of a base on commands, and on the motion of plants."""

import numpy as np
import pytest
from base_effect_parts import write_effects

from diffdrive_mpc import load_model, make_plant
from diffdrive_mpc.models.base_effects import BaseEffects, PoseMount, TwistSlew, WheelCommand, respond
from diffdrive_mpc.models.load import load_base_effects
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.base_commands import BaseCommands, CommandShaping
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import drive_open_loop, random_commands

DT = 0.0202


def drive_with(tmp_path, text, commands, **options):
    (tmp_path / "robot.yaml").write_text("description: a robot\n" + text)
    plant = make_plant(f"mujoco:{tmp_path / 'robot.yaml'}", **{"sensors": "perfect"} | options)
    return drive_open_loop(plant, commands)


def test_command_levels_equal_the_effects_of_models():
    """Ramps end at the values of `TwistSlew.follow`, and each level is rounded to whole steps of the wheels."""
    slew, wheels = TwistSlew(v=2.0, omega=3.0), WheelCommand(track=0.5, resolution=0.01)
    shaping = CommandShaping(BaseCommands(twist_slew=slew, wheel_command=wheels), DT)
    commands = np.repeat([(0.0, 0.0), (0.5, -1.0), (-0.2, 0.7)], 12, axis=0)
    ends = [list(shaping.levels(k * DT, command))[-1][1] for k, command in enumerate(commands)]
    np.testing.assert_allclose(ends, wheels.apply(slew.follow(commands, DT, (0.0, 0.0))), atol=1e-9)


def test_slew_limit_is_the_slope_of_the_speed(tmp_path):
    commands = np.tile([0.8, 0.0], (60, 1))
    speed = drive_with(tmp_path, "base: {twist_slew: {v: 0.5, omega: 2.0}}", commands).wheel_twist[:, 0]
    slope = (speed[55] - speed[35]) / (20 * DT)
    assert slope == pytest.approx(0.5, rel=0.02)


def test_base_has_two_sided_ranges_and_ramps(tmp_path):
    base = (
        "{twist_range: {v: {forward: 1.0, reverse: 0.2}}, twist_slew: {v: {accelerate: 0.5, brake: 1.0}, omega: 9.0}}"
    )
    commands = np.repeat([(0.5, 0.0), (0.0, 0.0), (-0.6, 0.0)], 70, axis=0)
    speed = drive_with(tmp_path, f"base: {base}", commands).wheel_twist[:, 0]
    assert (speed[45] - speed[25]) / (20 * DT) == pytest.approx(0.5, rel=0.02)
    assert (speed[90] - speed[80]) / (10 * DT) == pytest.approx(-1.0, rel=0.05)
    assert speed[-20:].min() == pytest.approx(-0.2, rel=0.05)


def test_two_sided_shaping_equals_the_effects_of_models():
    effects = BaseEffects(
        twist_range={"v": {"forward": 0.4, "reverse": 0.1}, "omega": {"left": 0.6, "right": 0.9}},
        twist_slew=TwistSlew(v={"accelerate": 1.0, "brake": 3.0}, omega={"accelerate": 4.0, "brake": 2.0}),
    )
    base = BaseCommands(twist_range=effects.twist_range, twist_slew=effects.twist_slew)
    commands = np.repeat([(0.0, 0.0), (0.5, -1.0), (-0.2, 0.7), (0.03, -0.7)], 12, axis=0)
    shaping = CommandShaping(base, DT)
    ends = [list(shaping.levels(k * DT, command))[-1][1] for k, command in enumerate(commands)]
    # The levels are exact across zero: the last part of a sample ends at the value of the full sample.
    expected = effects.twist_slew.follow(effects.twist_range.apply(commands), DT, (0.0, 0.0))
    np.testing.assert_allclose(ends, expected, atol=1e-12)


def test_base_without_effects_changes_no_motion(tmp_path):
    commands = np.tile([0.3, 0.5], (10, 1))
    expected = drive_with(tmp_path, "", commands)
    np.testing.assert_array_equal(drive_with(tmp_path, "base: {}", commands).true_pose, expected.true_pose)


def test_unequal_wheels_veer_as_geometry_predicts(tmp_path):
    """Larger wheels on the left turn the robot right, by their difference over the effective track."""
    commands = np.tile([0.5, 0.0], (150, 1))
    difference = 0.02
    text = f"twin: {{chassis: {{rolling_radii: [{1 + difference / 2}, {1 - difference / 2}]}}}}"
    drive = drive_with(tmp_path, text, commands)
    yaw_rate, speed = drive.true_twist[100:, 2].mean(), drive.true_twist[100:, 0].mean()
    skidding = 1.0 + (0.14 / 0.330) ** 2
    assert yaw_rate / speed == pytest.approx(-difference / (0.330 * skidding), rel=0.15)


def test_rolling_radius_scales_the_distance_per_encoder_count(tmp_path):
    drive = drive_with(tmp_path, "twin: {chassis: {rolling_radii: [0.9, 0.9]}}", np.tile([0.5, 0.0], (100, 1)))
    assert drive.true_twist[-1, 0] / drive.wheel_twist[-1, 0] == pytest.approx(0.9, rel=0.01)


def test_robot_file_sets_its_surface_and_sensors(tmp_path):
    """Named surfaces and sensors override those of the robot file."""
    commands = np.concatenate([np.tile([1.5, 0.0], (12, 1))])
    slippery = drive_with(tmp_path, "friction: 0.05", commands).true_twist[-1, 0]
    assert drive_with(tmp_path, "friction: 0.05", commands, surface="grippy").true_twist[-1, 0] > 2 * slippery
    sensors = "sensors: {gyro: {noise_sd: 0.0, bias_sd: 0.0}}"
    resting = drive_with(tmp_path, sensors, np.zeros((5, 2)), sensors="default")
    assert not resting.yaw_rate.any()
    assert drive_with(tmp_path, sensors, np.zeros((5, 2)), sensors="slam").yaw_rate.any()


TICK = load_robot().sample_time
EFFECTS = {
    "twist_slew": {"v": 0.8, "omega": 1.5},
    "wheel_command": {"track": 0.5, "resolution": 0.02, "coasting_speed": 0.08},
    "yaw_relaxation": {"angle": 0.04},
    "veer": {"yaw_per_metre": -0.05},
    "pose_mount": {"ahead": 0.1},
}


@pytest.fixture
def path(tmp_path):
    return write_effects(tmp_path / "base.yaml", EFFECTS)


def readings(plant, commands):
    """Return twists (K, 2) of gyro and encoders before each command, and the last pose."""
    twists = []
    for command in commands:
        measurement = plant.measure()
        twists.append([measurement.wheel_twist.value[0], float(measurement.yaw_rate.value)])
        plant.advance(command)
    return np.array(twists), plant.true_pose


def test_plant_of_a_file_with_effects_equals_the_free_run_of_that_file(path):
    commands = random_commands(4, duration=6.0)
    twists, _ = readings(make_plant(f"model:{path}", surface="ideal", sensors="perfect"), commands)
    response = respond(load_model(path), load_base_effects(path), commands, TICK)
    np.testing.assert_allclose(twists[:, 0], response.wheels[:, 0], atol=1e-12)
    np.testing.assert_allclose(twists[:, 1], response.body[:, 1], atol=1e-12)


def test_pose_mount_alone_leaves_twists_and_motion_unchanged():
    commands = random_commands(4, duration=3.0)
    slip, sensors = load_surface("default").slip, load_sensor_set("slam")
    runs = [
        readings(ModelPlant(load_model("ssm"), slip, sensors, 3, effects=effects), commands)
        for effects in (None, BaseEffects(pose_mount=PoseMount(ahead=0.2)))
    ]
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
