"""Wheel kinematics, and logs of wheels and of power."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_parts import bag_topics, drive, write_bag, write_mapping

from diffdrive_mpc.models import WheelKinematics
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.robot import load_robot

ROBOT = load_robot()
KINEMATICS = WheelKinematics(ROBOT.wheel_radius, ROBOT.track)
twists = st.tuples(st.floats(-1.5, 1.5), st.floats(-2, 2))


@given(twists)
def test_twist_is_recovered_from_the_wheel_speeds(twist):
    assert KINEMATICS.twist(KINEMATICS.wheel_speeds(twist)) == pytest.approx(twist, abs=1e-12)


@given(twists)
def test_pulses_per_second_equal_the_equation_of_the_paper(twist):
    v, omega = twist
    factor = ROBOT.encoder_pulses / (2 * np.pi * ROBOT.wheel_radius)
    left, right = factor * (v - omega * ROBOT.track / 2), factor * (v + omega * ROBOT.track / 2)
    pulses = KINEMATICS.wheel_speeds(twist) * ROBOT.encoder_pulses / (2 * np.pi)
    assert pulses == pytest.approx([left, right, left, right], abs=1e-9)


COLUMNS = drive(seconds=6.0)
T = COLUMNS["t"] + 1.0
RNG = np.random.default_rng(3)
# Single precision, as in the messages.
VOLTAGE, CURRENT = (np.float32(x).astype(float) for x in (12.0 + 0.1 * RNG.normal(size=300), 2 + RNG.random(300)))
MOTORS = np.float32(RNG.normal(size=(300, 4))).astype(float)
TOPICS = "topics:\n  command: /cmd_vel\n  odometry: /odom\n"
WHEELS = "wheels: {radius: 0.1, track: 0.4}\n"
JOINTS = "  motors:\n    left: {topic: /joints, joints: [fl, rl]}\n    right: {topic: /joints, joints: [fr, rr]}\n"


def write_log(tmp_path, battery=-CURRENT, **more):
    topics = bag_topics(COLUMNS) | {
        "/battery": ("sensor_msgs/msg/BatteryState", T + 0.003, T, np.column_stack([VOLTAGE, battery])),
        "/joints": ("sensor_msgs/msg/JointState", T + 0.002, T, MOTORS),
        "/left_a": ("std_msgs/msg/Float32", T, T, MOTORS[:, :1]),
        "/right_a": ("std_msgs/msg/Float32", T[::2] + 0.01, T[::2], MOTORS[::2, 1:2]),
    }
    return write_bag(tmp_path / "bag", topics | more)


def read_bag(tmp_path, text, **more):
    return read_log(write_log(tmp_path, **more), write_mapping(tmp_path / "m.yaml", TOPICS + text + WHEELS))


@pytest.mark.parametrize(("topic", "current"), [("/battery", -CURRENT), ("{topic: /battery, sign: -1}", CURRENT)])
def test_battery_power_is_positive_for_any_sign_of_the_log(tmp_path, topic, current):
    (record,) = read_bag(tmp_path, f"  battery: {topic}\n", battery=current).records
    assert np.array_equal(record.battery, np.column_stack([VOLTAGE, CURRENT]))
    assert record.motor_current is None


def test_efforts_of_joints_are_the_motors_of_the_sides(tmp_path):
    (record,) = read_bag(tmp_path, JOINTS).records
    assert np.array_equal(record.motor_currents, MOTORS)
    assert np.array_equal(record.motor_current, MOTORS[:, :2] + MOTORS[:, 2:])
    twist = record.twist
    assert record.wheels == pytest.approx((twist[:, :1] + [-0.2, 0.2] * twist[:, 1:]) / 0.1)


def test_single_numbers_have_their_times_of_receipt_and_units(tmp_path):
    text = "  motors: {left: {topic: /left_a, unit: mA}, right: /right_a}\n"
    (record,) = read_bag(tmp_path, text).records
    assert record.motor_currents is None
    assert record.motor_current[1:299, 0] == pytest.approx(1e-3 * MOTORS[1:299, 0])
    # Readings of the right side are half as frequent and half a sample later.
    expected = np.interp(T[1:299], T[::2] + 0.01, MOTORS[::2, 1])
    assert record.motor_current[1:299, 1] == pytest.approx(expected, abs=1e-4)


def test_non_finite_readings_are_skipped_with_a_finding(tmp_path):
    invalid = CURRENT.copy()
    invalid[50:60] = np.nan
    log = read_bag(tmp_path, "  battery: /battery\n", battery=-invalid)
    assert [finding.kind for finding in log.findings if "/battery" in finding.place] == ["NaN rows"]
    has_reading = np.isfinite(log.records[0].battery).all(axis=1)
    assert has_reading.sum() >= 285
