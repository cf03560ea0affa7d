"""What the simulated robot is made of, without a network: commands that lapse, odometry, messages, clocks."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.pace import SteppedClock, WallClock
from diffdrive_mpc.sim.ros.simulated_base import STOP, CommandInbox, load_base_settings
from diffdrive_mpc.sim.sensing.odometry import Odometry

SECOND = 10**9
DT = 0.02


@given(st.floats(-2, 2), st.floats(-2, 2), st.integers(1, 5 * SECOND), st.integers(0, 3 * SECOND))
def test_a_command_holds_for_the_timeout_and_not_longer(v, omega, start, later):
    inbox = CommandInbox(SECOND // 2, SECOND // 100)
    assert inbox.put(v, omega, 0, start) == ""
    assert inbox.command(start + later) == ((v, omega) if later <= SECOND // 2 else STOP)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_is_refused_and_the_last_one_holds_until_it_lapses(bad):
    inbox = CommandInbox(SECOND // 2, 0)
    inbox.put(0.5, 0.1, 0, SECOND)
    assert "not finite" in inbox.put(bad, 0.0, 0, SECOND) and "not finite" in inbox.put(0.0, bad, 0, SECOND)
    assert inbox.command(SECOND) == (0.5, 0.1)
    assert inbox.command(2 * SECOND) == STOP


def test_a_stamp_of_another_clock_is_refused_with_its_reason():
    inbox = CommandInbox(SECOND // 2, 0)
    assert "9.000 s ahead" in inbox.put(1.0, 0.0, 10 * SECOND, SECOND)
    assert "use_sim_time" in inbox.put(1.0, 0.0, SECOND, 10 * SECOND)
    assert inbox.command(10 * SECOND) == STOP and not inbox.lapsed(10 * SECOND)


def test_an_answer_is_known_by_its_stamp_or_else_by_its_receipt():
    inbox = CommandInbox(SECOND, SECOND // 100)
    assert not inbox.answers(SECOND)
    inbox.put(0.1, 0.0, SECOND - SECOND // 50, SECOND)
    assert not inbox.answers(SECOND)
    inbox.put(0.1, 0.0, SECOND + SECOND // 100, SECOND)
    assert inbox.answers(SECOND) and not inbox.answers(SECOND + SECOND // 40)
    inbox.put(0.1, 0.0, 0, 2 * SECOND)
    assert inbox.answers(2 * SECOND)


def ramp(k):
    """Twist (v, omega) of a robot that speeds up in a curve."""
    return 0.01 * k, 0.02 * k


def sensed(k, pose=None):
    v, omega = ramp(k)
    return Measurement(pose=pose, wheel_twist=Stamped((v, 1.6 * omega), k * DT), yaw_rate=Stamped(omega, k * DT))


def test_odometry_takes_speed_from_the_wheels_and_turning_from_the_gyro():
    start = np.array([1.0, -2.0, 0.3])
    odometry, truth = Odometry(start, 1, use_pose_sensor=False), start
    for k in range(80):
        if k:
            mean = 0.5 * (np.array(ramp(k - 1)) + np.array(ramp(k)))
            truth = integrate_pose(truth, mean[0], mean[1], DT)
        assert np.allclose(odometry.update(k * DT, sensed(k)), truth, rtol=0, atol=1e-12)


def test_a_silent_sensor_keeps_its_last_value():
    odometry = Odometry(np.zeros(3), 1, use_pose_sensor=False)
    straight = Measurement(wheel_twist=Stamped((0.5, 0.0), 0.0), yaw_rate=Stamped(0.0, 0.0))
    odometry.update(0.0, straight)
    assert np.allclose(odometry.update(1.0, Measurement()), [0.5, 0.0, 0.0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("latency", [0, 1, 4])
def test_a_late_pose_is_carried_on_by_the_motion_since(latency):
    """The sum is a metre and a radian off; one exact pose, however late, puts it right."""
    truth = [np.array([0.0, 0.0, 0.0])]
    odometry = Odometry([1.0, 0.0, 1.0], latency, use_pose_sensor=True)
    for k in range(60):
        if k:
            mean = 0.5 * (np.array(ramp(k - 1)) + np.array(ramp(k)))
            truth.append(integrate_pose(truth[-1], mean[0], mean[1], DT))
        pose = Stamped(truth[k - latency], (k - latency) * DT) if k == 50 else None
        found = odometry.update(k * DT, sensed(k, pose))
        if k >= 50:
            assert np.allclose(found, truth[k], rtol=0, atol=1e-12)
        else:
            assert np.linalg.norm(found - truth[k]) > 1.0


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(-30, 30))
def test_a_pose_message_is_a_unit_turn_about_the_vertical(x, y, theta):
    pose = messages.pose_message((x, y, theta))
    q = pose.orientation
    assert (pose.position.x, pose.position.y, q.x, q.y) == (x, y, 0.0, 0.0)
    assert abs(q.z**2 + q.w**2 - 1) < 1e-12
    assert abs(wrap_angle(2 * math.atan2(q.z, q.w) - theta)) < 1e-12


@given(st.integers(0, 2**31 * SECOND - 1))
def test_times_keep_every_nanosecond(now):
    assert messages.nanoseconds(messages.time_message(now)) == now


def test_covariances_stand_where_ros_has_them():
    """Row by row over x, y, z, roll, pitch, yaw."""
    known = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    found = np.reshape(messages.sensed_pose(0, Stamped((0, 0, 0), 0.0, known)).pose.covariance, (6, 6))
    assert np.array_equal(found[np.ix_([0, 1, 5], [0, 1, 5])], known)
    twist = messages.odometry(0, (0, 0, 0), Stamped((0.5, 0.1), 0.0, known[:2, :2])).twist
    assert (twist.covariance[0], twist.covariance[5], twist.covariance[35]) == (1.0, 2.0, 4.0)
    assert np.count_nonzero(found) == 9 and np.count_nonzero(twist.covariance) == 4


def test_an_exact_sensor_states_no_covariance():
    exact = messages.imu(0, Stamped(0.1, 0.0))
    assert not np.any(exact.angular_velocity_covariance)
    assert exact.orientation_covariance[0] == -1.0


def test_the_stepped_clock_stands_on_whole_samples():
    clock = SteppedClock(500, 0.0202)
    assert clock() == clock.origin == 10_100_000_000
    assert [clock.at(tick) - clock.origin for tick in (0, 1, 1000)] == [0, 20_200_000, 20_200_000_000]


def test_the_wall_clock_never_goes_back():
    clock = WallClock()
    times = [clock() for _ in range(1000)]
    assert times == sorted(times) and times[0] >= clock.origin


def test_changed_settings_are_checked_too():
    assert load_base_settings(changes={"stamped": False, "command_timeout": None}).stamped is False
    assert load_base_settings(changes={"lock_step.answer_timeout": 3.0}).lock_step.answer_timeout == 3.0
    with pytest.raises(ValueError, match="base settings: command_timeout: .* greater than 0"):
        load_base_settings(changes={"command_timeout": -1.0})
