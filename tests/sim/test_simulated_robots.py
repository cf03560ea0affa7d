"""Robots of the simulation: shipped, random, and assembled from parts."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import Measurement, Stamped, integrate_pose, make_plant
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.drawn_robot import draw_robot
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.simulated_robot import ROBOTS, load_simulated_robot
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.simulated_base import STOP, CommandInbox
from diffdrive_mpc.sim.sensing.odometry import Odometry
from studies.open_loop import OpenLoopDrive, drive_open_loop, random_commands

ROBOT_NAMES = ROBOTS.names
GRAVITY = 9.81


def _plant(name: str, surface: str = "default") -> MujocoPlant:
    return make_plant(f"mujoco:{name}", surface, "perfect")


def _drive_constant(name: str, v: float, omega: float, samples: int = 150) -> OpenLoopDrive:
    return drive_open_loop(_plant(name), np.tile([v, omega], (samples, 1)))


def _resting_loads(name: str) -> FloatArray:
    plant = _plant(name)
    for _ in range(50):
        plant.advance([0.0, 0.0])
    return plant.chassis.wheel_loads


@pytest.mark.parametrize("name", [name for name in ROBOT_NAMES if not load_simulated_robot(name).twin.chassis.castors])
def test_wheel_loads_balance_the_weight_at_the_centre_of_mass(name: str) -> None:
    """Balance of forces and moments: front left, front right, rear left, rear right."""
    build = load_simulated_robot(name)
    loads = _resting_loads(name)
    assert loads.sum() == pytest.approx(build.robot.mass * GRAVITY, rel=1e-3)
    ahead = build.twin.chassis.wheel_base / 2 * np.array([1, 1, -1, -1])
    left = build.robot.track / 2 * np.array([1, -1, 1, -1])
    # The robot leans on its tyres, which moves its centre of mass by less than a millimetre.
    np.testing.assert_allclose(
        [loads @ ahead / loads.sum(), loads @ left / loads.sum()], build.twin.chassis.centre_of_mass, atol=1e-3
    )


def test_file_without_changes_gives_the_default_robot_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "same.yaml"
    path.write_text("description: the same\n")
    commands = random_commands(7, duration=2.0)
    shipped, configured = (drive_open_loop(make_plant(name, seed=3), commands) for name in ("mujoco", f"mujoco:{path}"))
    for name in OpenLoopDrive.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(shipped, name), getattr(configured, name))


@pytest.mark.parametrize("name", ["default", *(name for name in ROBOT_NAMES if name.startswith("dead_time"))])
def test_robot_rests_until_the_dead_time_has_passed(name: str) -> None:
    dead_time = load_simulated_robot(name).twin.link.dead_time
    assert name in ("default", f"dead_time_{1e3 * dead_time:.0f}")
    log = _drive_constant(name, 0.6, 0.0, 15)
    moving = np.abs(log.true_twist[:, 0]) > 1e-3
    assert not moving[log.time <= dead_time].any()
    assert moving[log.time > dead_time + load_robot().sample_time].all()


@pytest.mark.parametrize("name", ["long", "long_naive", "wide", "wide_naive"])
def test_robot_with_other_geometry_turns_as_coulomb_friction_and_its_firmware_predict(name: str) -> None:
    """The yaw gain is firmware track / track for the wheels, times track^2 / (track^2 + wheel base^2) for the body."""
    build = load_simulated_robot(name)
    track, base = build.robot.track, build.twin.chassis.wheel_base
    expected = build.firmware.track / track * track**2 / (track**2 + base**2)
    ratio = _drive_constant(name, 0.0, 0.8).true_twist[75:, 2].mean() / 0.8
    assert ratio == pytest.approx(expected, abs=0.03)
    assert (abs(ratio - 1.0) < 0.03) == (not name.endswith("naive"))


CASTORS = (4, 10, 15, 20, 27, 28, 29, 39, 50, 52, 54, 57, 69, 110, 143, 152, 173, 182, 233, 249, 276)
"""Seeds of robots with castors that can drive the benchmark paths with their grip, slope and motors."""


def test_equal_seeds_draw_equal_robots():
    assert draw_robot(7) == draw_robot(7)


def test_slew_in_the_configuration_is_feasible_for_the_grip():
    """A robot with perfect sensors changes its yaw rate as fast as its stated limit, on any surface."""
    robot = min((draw_robot(seed) for seed in CASTORS), key=lambda r: r.stated["limits.omega_slew"])
    slew = robot.stated["limits.omega_slew"]
    assert 1.4 < slew < 6.0
    plant = make_plant(f"drawn:{robot.seed}", sensors="perfect", seed=robot.seed)
    plant.reset(np.zeros(3))
    steps = int(1.5 / plant.sample_time)
    for step in range(steps):
        plant.advance((0.0, min(1.0, slew * step * plant.sample_time)))
    assert plant.true_twist[2] == pytest.approx(1.0, abs=0.1)


def test_castors_turn_the_robot_about_its_driven_axle():
    """Two driven wheels turn the robot about the middle of their axle, as their geometry predicts."""
    robot = draw_robot(CASTORS[0])
    assert robot.build.twin.chassis.castors and not robot.scenario.kinds
    plant = make_plant(f"drawn:{robot.seed}", sensors="perfect", seed=robot.seed)
    plant.reset(np.zeros(3))
    for _ in range(150):
        plant.advance((0.0, 0.6))
    x, y, theta = plant.true_pose
    assert theta > 1.0
    assert np.hypot(x, y) < 0.05 * theta


SECOND = 10**9
DT = 0.02


@given(st.floats(-2, 2), st.floats(-2, 2), st.integers(1, 5 * SECOND), st.integers(0, 3 * SECOND))
def test_command_holds_until_the_timeout(v, omega, start, delay):
    inbox = CommandInbox(SECOND // 2, SECOND // 100)
    assert inbox.put(v, omega, 0, start) == ""
    assert inbox.command(start + delay) == ((v, omega) if delay <= SECOND // 2 else STOP)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_command_is_refused_and_the_last_command_holds_until_the_timeout(value):
    inbox = CommandInbox(SECOND // 2, 0)
    inbox.put(0.5, 0.1, 0, SECOND)
    assert "not finite" in inbox.put(value, 0.0, 0, SECOND) and "not finite" in inbox.put(0.0, value, 0, SECOND)
    assert inbox.command(SECOND) == (0.5, 0.1)
    assert inbox.command(2 * SECOND) == STOP


def test_response_is_identified_by_its_stamp_or_else_by_its_receipt():
    inbox = CommandInbox(SECOND, SECOND // 100)
    assert not inbox.has_command_for(SECOND)
    inbox.put(0.1, 0.0, SECOND - SECOND // 50, SECOND)
    assert not inbox.has_command_for(SECOND)
    inbox.put(0.1, 0.0, SECOND + SECOND // 100, SECOND)
    assert inbox.has_command_for(SECOND) and not inbox.has_command_for(SECOND + SECOND // 40)
    inbox.put(0.1, 0.0, 0, 2 * SECOND)
    assert inbox.has_command_for(2 * SECOND)


def ramp(k):
    """Return the twist (v, omega) at tick k of a robot that speeds up in a curve."""
    return 0.01 * k, 0.02 * k


def measurement_at(k, pose=None):
    v, omega = ramp(k)
    return Measurement(pose=pose, wheel_twist=Stamped((v, 1.6 * omega), k * DT), yaw_rate=Stamped(omega, k * DT))


def test_odometry_uses_speed_from_the_wheels_and_turning_from_the_gyro():
    start = np.array([1.0, -2.0, 0.3])
    odometry, truth = Odometry(start, 1, use_pose_sensor=False), start
    for k in range(80):
        if k:
            mean = 0.5 * (np.array(ramp(k - 1)) + np.array(ramp(k)))
            truth = integrate_pose(truth, mean[0], mean[1], DT)
        assert np.allclose(odometry.update(k * DT, measurement_at(k)), truth, rtol=0, atol=1e-12)


def test_odometry_corrects_the_scales_of_its_sensors():
    odometry = Odometry(np.zeros(3), 1, use_pose_sensor=False, correction=(-1.0, -2.0))
    turned = Measurement(wheel_twist=Stamped((-0.5, 0.0), 0.0), yaw_rate=Stamped(-2.0, 0.0))
    odometry.update(0.0, turned)
    assert odometry.update(0.1, turned)[2] == pytest.approx(0.1) and odometry.update(0.2, turned)[0] > 0.0


def test_odometry_holds_the_last_value_of_a_sensor_without_readings():
    odometry = Odometry(np.zeros(3), 1, use_pose_sensor=False)
    straight = Measurement(wheel_twist=Stamped((0.5, 0.0), 0.0), yaw_rate=Stamped(0.0, 0.0))
    odometry.update(0.0, straight)
    assert np.allclose(odometry.update(1.0, Measurement()), [0.5, 0.0, 0.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("latency", [0, 1, 4])
def test_late_pose_is_propagated_by_the_motion_since(latency):
    """Odometry is off by a metre and a radian; one exact pose corrects it, independent of its latency."""
    truth = [np.array([0.0, 0.0, 0.0])]
    odometry = Odometry([1.0, 0.0, 1.0], latency, use_pose_sensor=True)
    for k in range(60):
        if k:
            mean = 0.5 * (np.array(ramp(k - 1)) + np.array(ramp(k)))
            truth.append(integrate_pose(truth[-1], mean[0], mean[1], DT))
        pose = Stamped(truth[k - latency], (k - latency) * DT) if k == 50 else None
        estimate = odometry.update(k * DT, measurement_at(k, pose))
        if k >= 50:
            assert np.allclose(estimate, truth[k], rtol=0, atol=1e-12)
        else:
            assert np.linalg.norm(estimate - truth[k]) > 1.0


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-30, 30))
def test_pose_message_is_a_unit_turn_about_the_vertical(x, y, theta):
    pose = messages.pose_message((x, y, theta))
    q = pose.orientation
    assert (pose.position.x, pose.position.y, q.x, q.y) == (x, y, 0.0, 0.0)
    assert abs(q.z**2 + q.w**2 - 1) < 1e-12
    assert abs(wrap_angle(2 * math.atan2(q.z, q.w) - theta)) < 1e-12


@given(st.integers(0, 2**31 * SECOND - 1))
def test_times_are_exact_to_the_nanosecond(now):
    assert messages.nanoseconds(messages.time_message(now)) == now


def test_covariances_have_the_layout_of_ros():
    """Rows and columns are x, y, z, roll, pitch, yaw."""
    known = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    covariance = np.reshape(messages.measured_pose(0, Stamped((0, 0, 0), 0.0, known)).pose.covariance, (6, 6))
    assert np.array_equal(covariance[np.ix_([0, 1, 5], [0, 1, 5])], known)
    twist = messages.odometry(0, (0, 0, 0), Stamped((0.5, 0.1), 0.0, known[:2, :2])).twist
    assert (twist.covariance[0], twist.covariance[5], twist.covariance[35]) == (1.0, 2.0, 4.0)
    assert np.count_nonzero(covariance) == 9 and np.count_nonzero(twist.covariance) == 4
