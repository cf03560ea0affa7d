"""Unit tests of link, firmware, speed observer, velocity loops and motors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import make_plant
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops, motor_work
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot, load_simulated_robot
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import drive_open_loop, random_commands

ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps
PULSE = 2 * np.pi / ROBOT.encoder_pulses


@given(
    dead_time=st.floats(0.0, 0.2),
    values=st.lists(st.floats(-1, 1), min_size=1, max_size=20),
    substeps=st.integers(1, 12),
)
def test_delay_line_preserves_the_integral(dead_time: float, values: list[float], substeps: int) -> None:
    """The integral of the output up to t is the integral of the input up to t - dead time."""
    line = DelayLine(dead_time)
    step, integral = 0.02 / substeps, 0.0
    for k, value in enumerate(values):
        line.send(0.02 * k, np.array([value, -value]))
        for i in range(substeps):
            start = 0.02 * k + i * step
            mean = line.mean(start, start + step)
            assert mean[0] == -mean[1]
            integral += mean[0] * step
    elapsed = 0.02 * len(values) - dead_time
    expected = sum(value * min(max(elapsed - 0.02 * k, 0.0), 0.02) for k, value in enumerate(values))
    assert integral == pytest.approx(expected, abs=1e-9)


def test_firmware_step_response_is_a_first_order_lag_rounded_to_pulses() -> None:
    firmware = load_firmware()
    shaper = CommandShaper(firmware, ROBOT, STEP)
    steps = round(firmware.lag_v / STEP)
    for _ in range(steps):
        set_points = shaper.set_points(np.array([0.8, 0.0]))
    gain = firmware.gain_v / ROBOT.wheel_radius
    np.testing.assert_allclose(set_points, gain * 0.8 * (1 - np.exp(-steps * STEP / firmware.lag_v)), atol=PULSE / 2)
    pulses = set_points / PULSE
    np.testing.assert_allclose(pulses, np.round(pulses), atol=1e-9)


def test_firmware_uses_the_track_of_the_firmware_file() -> None:
    firmware = load_firmware()
    shaper = CommandShaper(firmware, ROBOT, STEP)
    for _ in range(2000):
        left, right = shaper.set_points(np.array([0.0, 1.0]))[:2]
    assert (right - left) * ROBOT.wheel_radius / firmware.track == pytest.approx(1.0, abs=2e-3)


@given(speed=st.floats(-30, 30), phase=st.floats(0, 1, exclude_max=True))
def test_observer_estimates_a_constant_speed(speed: float, phase: float) -> None:
    observer = SpeedObserver(TWIN.driver.observer_bandwidth, PULSE, STEP, np.full(4, phase))
    estimates = np.array([observer.update(np.full(4, speed * STEP * (k + 1))) for k in range(1200)])[200:]
    # Over 1000 steps the count is wrong by at most one pulse at either end, as is the observer's angle.
    assert np.abs(estimates.mean(axis=0) - speed).max() < 4 * PULSE / (1000 * STEP)
    raw_count = PULSE / STEP
    assert np.abs(estimates - speed).max() < 0.25 * raw_count


def test_observer_stays_at_zero_at_rest() -> None:
    observer = SpeedObserver(TWIN.driver.observer_bandwidth, PULSE, STEP, np.array([0.0, 0.3, 0.5, 0.9]))
    for _ in range(100):
        assert np.all(observer.update(np.zeros(4)) == 0.0)


def _loops() -> VelocityLoops:
    return VelocityLoops(TWIN.driver, TWIN.motor, PULSE, STEP)


@given(speed=st.floats(-32, 32), set_point=st.floats(-32, 32))
def test_torque_stays_within_the_torque_speed_line_of_the_motor(speed: float, set_point: float) -> None:
    motor = TWIN.motor
    speeds = np.full(4, speed)
    torque = _loops().torque(np.full(4, set_point), speeds, speeds)
    stall = motor.stall_torque * np.array(motor.spread)
    assert np.all(torque <= stall * (1 - speed / motor.no_load_speed) + 1e-12)
    assert np.all(torque >= stall * (-1 - speed / motor.no_load_speed) - 1e-12)


def test_integrator_does_not_wind_up_while_the_duty_is_at_its_limit() -> None:
    loops = _loops()
    fast, slow = np.full(4, 30.0), np.zeros(4)
    for _ in range(500):
        loops.torque(fast, slow, slow)
    # The first step at the set-point must give nearly the torque of a new loop.
    np.testing.assert_allclose(loops.torque(fast, fast, fast), _loops().torque(fast, fast, fast), atol=1e-9)


def test_driver_brakes_without_oscillation_at_a_zero_set_point() -> None:
    torque = _loops().torque(np.zeros(4), np.full(4, 0.1), np.full(4, 0.1))
    motor = TWIN.motor
    np.testing.assert_allclose(torque, -motor.stall_torque * np.array(motor.spread) * 0.1 / motor.no_load_speed)


def test_delay_line_preserves_the_order_beyond_its_initial_capacity() -> None:
    line = DelayLine(1.0)
    for k in range(100):
        line.send(0.01 * k, np.array([float(k), -float(k)]))
        if k == 20:
            line.mean(0.0, 0.01)
    for k in range(99):
        start = 1.0 + 0.01 * k
        np.testing.assert_allclose(line.mean(start, start + 0.01), [k, -k], atol=1e-9)


def make_built_plant(build: SimulatedRobot, friction: float) -> MujocoPlant:
    sensors = load_sensor_set("perfect")
    return MujocoPlant(friction, sensors, robot=build.robot, twin=build.twin, firmware=build.firmware)


def with_driver(build: SimulatedRobot, **values: float | None) -> SimulatedRobot:
    driver = build.twin.driver.model_copy(update=values)
    return build.model_copy(update={"twin": build.twin.model_copy(update={"driver": driver})})


def test_motor_work_on_a_straight_line_is_kinetic_energy() -> None:
    """Without drag, and with little slip, the work of the motors becomes kinetic energy."""
    robot = make_plant("mujoco", sensors="perfect")
    robot.reset(np.zeros(3))
    work = 0.0
    for k in range(60):
        robot.advance([min(0.02 * k, 0.8), 0.0])
        work += float(motor_work(robot).power.sum()) * robot.sample_time
    assert 0 <= work - robot.chassis.energy < 0.03 * work


def test_motor_work_in_a_steady_turn_becomes_heat() -> None:
    robot = make_plant("mujoco", sensors="perfect")
    robot.reset(np.zeros(3))
    for _ in range(100):
        robot.advance([0.3, 0.6])
    start_energy, work = robot.chassis.energy, 0.0
    for _ in range(100):
        robot.advance([0.3, 0.6])
        work += float(motor_work(robot).power.sum()) * robot.sample_time
    assert abs(robot.chassis.energy - start_energy) < 0.01 * work
    # The motors cannot deliver more power than friction dissipates while the wheels slide.
    max_work = 0.8 * 9.81 * 6.85 * 2.02 * np.hypot(0.6 * 0.5, 0.6 * 0.3)
    assert 0.1 * max_work < work < max_work


def test_outer_motors_drive_and_inner_motors_brake() -> None:
    drive = drive_open_loop(make_plant("mujoco", sensors="perfect"), np.tile([0.4, 0.8], (150, 1)))
    left, right = (drive.motor_torque[75:, side].sum(axis=1).mean() for side in ([0, 2], [1, 3]))
    assert left < 0 < right
    assert (drive.motor_square >= drive.motor_torque**2 - 1e-12).all()


def test_torque_of_a_straight_drive_equals_the_drag() -> None:
    build = load_simulated_robot("fsu_bot")
    drive = drive_open_loop(make_built_plant(build, 0.8), np.tile([0.4, 0.0], (300, 1)))
    assert drive.motor_torque[200:].mean(axis=0) == pytest.approx(build.twin.chassis.wheel_drag, rel=0.05)


def test_drivers_limit_the_torque_which_widens_the_turn() -> None:
    limited = load_simulated_robot("fsu_bot")
    limit = limited.twin.driver.torque_limit
    free = with_driver(limited, torque_limit=None)
    tight = np.tile([0.4, 0.8], (200, 1))
    limited_drive, free_drive = (drive_open_loop(make_built_plant(robot, 1.2), tight) for robot in (limited, free))
    assert np.abs(limited_drive.motor_torque).max() <= limit + 1e-12  # rounding of a mean of ten
    assert np.abs(free_drive.motor_torque[100:]).max() > 1.1 * limit
    assert limited_drive.true_twist[150:, 2].mean() < 0.8 * free_drive.true_twist[150:, 2].mean()


def test_disturbed_sample_reports_the_weakened_torque() -> None:
    healthy = drive_open_loop(make_plant("mujoco", seed=2), random_commands(2)[:200])
    weak = drive_open_loop(make_plant("mujoco", seed=2, scenario="weak_motor"), random_commands(2)[:200])
    assert np.isfinite(weak.motor_torque).all()
    assert not np.array_equal(weak.motor_torque, healthy.motor_torque)
