"""Messages to numbers and back, times, and references laid elsewhere."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Controller, Hold, Measurement, Mode, Stamped, load_config, load_trajectory
from diffdrive_mpc.mpc.ros.conversions import (
    MessageError,
    measured_pose,
    nanoseconds,
    planar_pose,
    pose_message,
    time_message,
    yaw_of,
)
from diffdrive_mpc.mpc.ros.latency import Durations, LoopTimes
from diffdrive_mpc.mpc.trajectories.moved import starting_at

METRES = st.floats(-1e3, 1e3)
ANGLES = st.floats(-10, 10)


@given(METRES, METRES, ANGLES)
def test_a_pose_survives_the_message(x, y, theta):
    back = planar_pose(pose_message((x, y, theta)))
    assert back[:2] == (x, y)
    assert abs(wrap_angle(back[2] - theta)) < 1e-9


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_a_time_survives_the_message(time):
    assert nanoseconds(time_message(time)) == time


@given(ANGLES, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_yaw_is_that_of_the_x_axis_on_the_floor(yaw, pitch, roll):
    """Composed from the half-angle quaternions of z, y, x; the x axis then points to (yaw, -pitch)."""

    def half(angle):
        return math.cos(angle / 2), math.sin(angle / 2)

    (cz, sz), (cy, sy), (cx, sx) = half(yaw), half(pitch), half(roll)
    q = Quaternion(
        w=cz * cy * cx + sz * sy * sx,
        x=cz * cy * sx - sz * sy * cx,
        y=cz * sy * cx + sz * cy * sx,
        z=sz * cy * cx - cz * sy * sx,
    )
    assert abs(wrap_angle(yaw_of(q) - yaw)) < 1e-9


@pytest.mark.parametrize("q", [Quaternion(w=0.0), Quaternion(w=2.0), Quaternion(w=math.nan), Quaternion(x=1e200)])
def test_what_is_no_rotation_is_refused(q):
    with pytest.raises(MessageError, match="no unit quaternion"):
        yaw_of(q)


def test_the_covariance_of_a_pose_is_its_planar_part_and_zero_means_unknown():
    message = PoseWithCovarianceStamped()
    assert measured_pose(message, 0, covariance=True).covariance is None
    message.pose.covariance = [float(index) for index in range(36)]
    expected = [[0, 1, 5], [6, 7, 11], [30, 31, 35]]
    np.testing.assert_array_equal(measured_pose(message, 0, covariance=True).covariance, expected)
    assert measured_pose(message, 0, covariance=False).covariance is None


@given(st.lists(st.floats(0, 1), min_size=1, max_size=50), st.integers(1, 20))
def test_percentiles_are_those_of_the_window(values, window):
    durations = Durations(window)
    for value in values:
        durations.add(value)
    found, kept = durations.percentiles(), values[-window:]
    assert found.count == len(kept)
    assert found.max == max(kept)
    assert min(kept) <= found.p50 <= found.p99 <= found.max


def test_late_and_long_ticks_are_misses():
    times = LoopTimes(0.02, 100)
    for begin, duration in ((0.0, 0.001), (0.0201, 0.001), (0.06, 0.001), (0.08, 0.03)):
        times.begin(begin)
        times.end(duration, None)
    assert times.misses == 2
    assert times.jitter.percentiles().max == pytest.approx(0.0199)
    assert times.latency.percentiles().count == 0


@given(METRES, METRES, ANGLES)
def test_a_moved_reference_starts_where_it_shall_and_keeps_its_shape(x, y, theta):
    original = load_trajectory("s")
    moved = starting_at(original, (x, y, theta))
    times = np.linspace(0.0, original.duration, 7)
    before, after = original.sample(times), moved.sample(times)
    np.testing.assert_allclose(after.pose[0], [x, y, theta], atol=1e-9)
    np.testing.assert_array_equal(after.twist, before.twist)
    distance = np.hypot(*np.diff(before.pose[:, :2], axis=0).T)
    np.testing.assert_allclose(np.hypot(*np.diff(after.pose[:, :2], axis=0).T), distance, atol=1e-9)
    np.testing.assert_allclose(np.diff(after.pose[:, 2]), np.diff(before.pose[:, 2]), atol=1e-9)


@pytest.mark.parametrize(("failure", "drives_on"), [(False, True), (True, False)])
def test_a_hold_brakes_and_only_a_failure_is_final(failure, drives_on):
    config = load_config("ssm", {"failure.resume": False})
    controller, dt = Controller(config), config.sample_time
    reference = load_trajectory("circle")
    controller.start(reference, 0.0)

    def steps(first, count, hold=None):
        for k in range(first, first + count):
            pose = Stamped(reference.sample([k * dt if hold is None else first * dt]).pose[0], k * dt)
            found = controller.step(k * dt, Measurement(pose=pose), hold)
        return found

    assert steps(0, 10).mode is Mode.TRACKING
    held = steps(10, 20, Hold("wait", failure=failure))
    assert held.mode is Mode.STOPPED
    assert "wait" in held.message
    assert held.progress == 0.0
    after = controller.step(30 * dt, Measurement(pose=Stamped(reference.sample([10 * dt]).pose[0], 30 * dt)))
    assert (after.mode is Mode.TRACKING) == drives_on
