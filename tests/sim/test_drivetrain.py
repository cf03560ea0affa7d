"""Link, firmware, speed observer and velocity loops on their own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.drivetrain import CommandShaper, DelayLine, SpeedObserver, VelocityLoops
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware, load_twin_parameters

ROBOT, TWIN = load_robot(), load_twin_parameters()
STEP = ROBOT.sample_time / TWIN.substeps
PULSE = 2 * np.pi / ROBOT.encoder_pulses


@given(
    dead_time=st.floats(0.0, 0.2),
    values=st.lists(st.floats(-1, 1), min_size=1, max_size=20),
    substeps=st.integers(1, 12),
)
def test_delay_line_passes_on_the_exact_integral(dead_time: float, values: list[float], substeps: int) -> None:
    """The integral of what arrives up to t is the integral of what was sent up to t - dead time."""
    line = DelayLine(dead_time)
    step, integral = 0.02 / substeps, 0.0
    for k, value in enumerate(values):
        line.send(0.02 * k, np.array([value, -value]))
        for i in range(substeps):
            start = 0.02 * k + i * step
            mean = line.mean(start, start + step)
            assert mean[0] == -mean[1]
            integral += mean[0] * step
    seen = 0.02 * len(values) - dead_time
    sent = sum(value * min(max(seen - 0.02 * k, 0.0), 0.02) for k, value in enumerate(values))
    assert integral == pytest.approx(sent, abs=1e-9)


def test_firmware_step_response_is_a_first_order_lag_to_whole_pulses() -> None:
    firmware = load_firmware()
    shaper = CommandShaper(firmware, ROBOT, STEP)
    steps = round(firmware.lag_v / STEP)
    for _ in range(steps):
        set_points = shaper.set_points(np.array([0.8, 0.0]))
    gain = firmware.gain_v / ROBOT.wheel_radius
    np.testing.assert_allclose(set_points, gain * 0.8 * (1 - np.exp(-steps * STEP / firmware.lag_v)), atol=PULSE / 2)
    pulses = set_points / PULSE
    np.testing.assert_allclose(pulses, np.round(pulses), atol=1e-9)


def test_firmware_divides_by_its_own_track() -> None:
    firmware = load_firmware()
    shaper = CommandShaper(firmware, ROBOT, STEP)
    for _ in range(2000):
        left, right = shaper.set_points(np.array([0.0, 1.0]))[:2]
    assert (right - left) * ROBOT.wheel_radius / firmware.track == pytest.approx(1.0, abs=2e-3)


@given(speed=st.floats(-30, 30), phase=st.floats(0, 1, exclude_max=True))
def test_observer_finds_a_constant_speed(speed: float, phase: float) -> None:
    observer = SpeedObserver(TWIN.driver.observer_bandwidth, PULSE, STEP, np.full(4, phase))
    estimates = np.array([observer.update(np.full(4, speed * STEP * (k + 1))) for k in range(1200)])[200:]
    # Over 1000 steps the count is at most one pulse off at either end, and so is the observer's angle.
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
def test_torque_stays_on_the_motors_line(speed: float, set_point: float) -> None:
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
    # The first step at the set-point must give nearly what a fresh loop gives.
    np.testing.assert_allclose(loops.torque(fast, fast, fast), _loops().torque(fast, fast, fast), atol=1e-9)


def test_driver_brakes_without_hunting_at_a_zero_set_point() -> None:
    torque = _loops().torque(np.zeros(4), np.full(4, 0.1), np.full(4, 0.1))
    motor = TWIN.motor
    np.testing.assert_allclose(torque, -motor.stall_torque * np.array(motor.spread) * 0.1 / motor.no_load_speed)
