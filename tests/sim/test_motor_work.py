"""What the motors of the twin really did: work, energy, limits; and that nobody else's run changes by it."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc.sim.plants.drivetrain import motor_work
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, load_simulated_robot
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from oracle.drivetrain import Drivetrain


def plant(build: SimulatedRobot, friction: float) -> MujocoPlant:
    sensors = load_sensor_set("perfect")
    return MujocoPlant(friction, sensors, robot=build.robot, twin=build.twin, firmware=build.firmware)


def with_driver(build: SimulatedRobot, **values: float | None) -> SimulatedRobot:
    driver = build.twin.driver.model_copy(update=values)
    return build.model_copy(update={"twin": build.twin.model_copy(update={"driver": driver})})


def test_speeding_up_straight_on_the_work_is_in_the_motion() -> None:
    """No drag, hardly any slip: what the motors gave is kinetic energy."""
    robot = make_plant("mujoco", sensors="perfect")
    assert isinstance(robot, MujocoPlant)
    robot.reset(np.zeros(3))
    work = 0.0
    for k in range(60):
        robot.advance([min(0.02 * k, 0.8), 0.0])
        work += float(motor_work(robot).power.sum()) * robot.sample_time
    assert 0 <= work - robot.chassis.energy < 0.03 * work


def test_in_a_steady_turn_work_goes_on_and_becomes_heat() -> None:
    robot = make_plant("mujoco", sensors="perfect")
    assert isinstance(robot, MujocoPlant)
    robot.reset(np.zeros(3))
    for _ in range(100):
        robot.advance([0.3, 0.6])
    before, work = robot.chassis.energy, 0.0
    for _ in range(100):
        robot.advance([0.3, 0.6])
        work += float(motor_work(robot).power.sum()) * robot.sample_time
    assert abs(robot.chassis.energy - before) < 0.01 * work
    # No motor can give more than friction times load under its wheel takes while it slides.
    most = 0.8 * 9.81 * 6.85 * 2.02 * np.hypot(0.6 * 0.5, 0.6 * 0.3)
    assert 0.1 * most < work < most


def test_outer_motors_drive_and_inner_ones_brake() -> None:
    drive = drive_open_loop(make_plant("mujoco", sensors="perfect"), np.tile([0.4, 0.8], (150, 1)))
    left, right = (drive.motor_torque[75:, side].sum(axis=1).mean() for side in ([0, 2], [1, 3]))
    assert left < 0 < right
    assert (drive.motor_square >= drive.motor_torque**2 - 1e-12).all()


def test_drag_is_what_a_straight_way_costs() -> None:
    build = load_simulated_robot("fsu_bot")
    drive = drive_open_loop(plant(build, 0.8), np.tile([0.4, 0.0], (300, 1)))
    assert drive.motor_torque[200:].mean(axis=0) == pytest.approx(build.twin.chassis.wheel_drag, rel=0.05)


def test_the_drivers_keep_the_torque_within_their_limit_and_the_turn_gets_wider() -> None:
    limited = load_simulated_robot("fsu_bot")
    limit = limited.twin.driver.torque_limit
    assert limit is not None
    free = with_driver(limited, torque_limit=None)
    tight = np.tile([0.4, 0.8], (200, 1))
    kept, strong = (drive_open_loop(plant(one, 1.2), tight) for one in (limited, free))
    assert np.abs(kept.motor_torque).max() <= limit + 1e-12  # a mean of ten is rounded
    assert np.abs(strong.motor_torque[100:]).max() > 1.1 * limit
    assert kept.true_twist[150:, 2].mean() < 0.8 * strong.true_twist[150:, 2].mean()


def test_the_limit_is_that_of_the_oracle_bit_for_bit() -> None:
    from diffdrive_mpc.sim.plants.drivetrain import VelocityLoops

    build = load_simulated_robot("fsu_bot")
    step, pulse = build.robot.sample_time / 10, 2 * np.pi / build.robot.encoder_pulses
    oracle = Drivetrain(build.firmware, build.twin, build.robot, step, [0.0] * 4)
    loops = VelocityLoops(build.twin.driver, build.twin.motor, pulse, step)
    rng, limited = np.random.default_rng(1), 0
    for k in range(500):
        command = rng.uniform(-1, 1, 2).tolist()
        if k % 10 == 0:
            oracle.send(k * step, command)
        speeds = rng.normal(0, 2, 4)
        # Both get the oracle's set-points: what is compared is the loop.
        shaped = Drivetrain(build.firmware, build.twin, build.robot, step, [0.0] * 4)
        shaped.__dict__.update({name: value for name, value in oracle.__dict__.items() if name != "under_way"})
        shaped.under_way = oracle.under_way.copy()
        points = np.array(shaped.set_points(shaped.arrived(k * step, (k + 1) * step)))
        torques = loops.torque(points, np.array(oracle.speed), speeds)
        assert torques.tolist() == oracle.torques(k * step, (k + 1) * step, speeds.tolist())
        limited += int(np.any(np.abs(torques) == build.twin.driver.torque_limit))
    assert limited > 50


def test_a_disturbed_sample_tells_the_weakened_torque() -> None:
    healthy = drive_open_loop(make_plant("mujoco", seed=2), random_commands(2)[:200])
    weak = drive_open_loop(make_plant("mujoco", seed=2, scenario="weak_motor"), random_commands(2)[:200])
    assert np.isfinite(weak.motor_torque).all()
    assert not np.array_equal(weak.motor_torque, healthy.motor_torque)


def test_a_velocity_model_has_no_motors() -> None:
    drive = drive_open_loop(make_plant("model:ssm"), np.tile([0.4, 0.0], (5, 1)))
    assert np.isnan(drive.motor_torque).all()
    assert drive.motor_torque.shape == (5, 4)
