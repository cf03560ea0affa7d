"""Messages: what they say of a tick, and conversions."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from ros_parts import CONFIG, DT, drive_along, stack
from std_msgs.msg import Float64MultiArray

from diffdrive_mpc import load_trajectory
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.config.schema import Limits
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
from diffdrive_mpc.mpc.ros.reference_input import timed_trajectory_reference
from diffdrive_mpc.mpc.trajectories.moved import starting_at

RADIUS = 0.0675


def stamped_points(frame="odom", last="odom"):
    """As nav_msgs/Trajectory has it: a header in each point; 1 m ahead in 4 s."""
    times = np.linspace(0.0, 4.0, 21)
    x = 0.5 - 0.5 * np.cos(np.pi * times / 4.0)
    points = [
        SimpleNamespace(
            header=SimpleNamespace(stamp=time_message(10**12 + round(1e9 * at)), frame_id=frame),
            pose=pose_message((ahead, 0.0, 0.0)),
        )
        for at, ahead in zip(times, x, strict=True)
    ]
    points[-1].header.frame_id = last
    return SimpleNamespace(header=SimpleNamespace(stamp=time_message(0), frame_id=frame), points=points)


def test_a_trajectory_with_stamped_points_is_read():
    reference = timed_trajectory_reference(stamped_points(), Limits())
    assert reference.duration == pytest.approx(4.0)
    np.testing.assert_allclose(reference.sample([2.0]).pose[0], (0.5, 0.0, 0.0), atol=1e-3)


def test_a_point_in_another_frame_is_refused():
    with pytest.raises(MessageError, match="point 20 is in 'map', the trajectory in 'odom'"):
        timed_trajectory_reference(stamped_points(last="map"), Limits())


def test_a_trajectory_of_the_installed_type_is_driven(ros_types):
    from diffdrive_mpc.mpc.ros.reference_input import timed_trajectory_type

    kind = timed_trajectory_type()
    assert kind is not None
    with stack(trajectory="''", drive_on_reference=True) as s:
        message = kind()
        message.header.frame_id = "odom"
        for point in stamped_points().points:
            timed = type(message).SLOT_TYPES[1].value_type
            assert timed.name == "TrajectoryPoint"
            made = __import__(timed.namespaces[0] + ".msg", fromlist=["msg"]).TrajectoryPoint(pose=point.pose)
            at = nanoseconds(point.header.stamp) - 10**12
            made.time_from_start.sec, made.time_from_start.nanosec = divmod(at, 10**9)
            message.points.append(made)
        drive_along(s, message, "set_timed_trajectory")


def test_the_estimate_is_odometry_with_frames_and_covariance():
    with stack(drive=True) as s:
        heard = s.listen(Odometry, "/diffdrive_mpc/estimate")
        s.base.until(lambda: s.base.silent(1) is not None and heard, "the estimate")
        s.base.run(80)
        s.base.until(lambda: nanoseconds(heard[-1].header.stamp) == s.base.now, "that of the last tick")
        message, estimate = heard[-1], s.loop.last.result.estimate
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        pose = message.pose.pose
        said = (pose.position.x, pose.position.y, yaw_of(pose.orientation))
        np.testing.assert_allclose(said, estimate.pose, atol=1e-9)
        np.testing.assert_allclose((message.twist.twist.linear.x, message.twist.twist.angular.z), estimate.twist)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        np.testing.assert_allclose(np.diag(covariance)[[0, 1, 5]], estimate.pose_deviation**2)
        assert np.diag(covariance)[[0, 1, 5]].min() > 0.0
        assert np.count_nonzero(covariance) == 3
        # Before the last command moved it; the plant is a tick further.
        np.testing.assert_allclose(said[:2], s.base.plant.true_pose[:2], atol=0.03)


def as_twist(speeds, track):
    left, right = RADIUS * speeds[0], RADIUS * speeds[1]
    return 0.5 * (left + right), (right - left) / track


class WheelBase:
    """A stack whose base takes wheel speeds in place of twists."""

    def __init__(self, s, *, crossed=False):
        self.s, self.heard, self.crossed = s, [], crossed
        s.base.node.create_subscription(Float64MultiArray, "wheel_commands", self.take, 1)

    def take(self, message):
        self.heard.append(list(message.data))
        self.s.base.commands.append(as_twist(message.data[:: -1 if self.crossed else 1], CONFIG.wheels.track))
        self.s.base.times.append(self.s.base.now)


def wheels(overrides=None, **parameters):
    return stack(overrides, **{"command_output": "wheels", "wheel_radius": RADIUS, "autostart": False, **parameters})


def begin(s, *, crossed=False):
    """Activate the node and have it drive, its base listening to wheel speeds."""
    base = WheelBase(s, crossed=crossed)
    s.node.trigger_configure()
    s.node.trigger_activate()
    s.base.until(s.hears, "sensors")
    assert s.trigger("start").success
    return base


def test_wheel_speeds_drive_a_base_without_a_twist():
    with wheels() as s:
        base = begin(s)
        s.base.run(100)
        assert s.loop.last.mode == Mode.TRACKING
        assert s.base.plant.true_pose[0] > 0.3
        np.testing.assert_allclose(s.base.commands[-1], s.loop.last.command, atol=1e-12)
        assert not s.node.count_publishers("/cmd_vel")
        s.node.trigger_deactivate()
        s.base.until(lambda: base.heard[-1] == [0.0, 0.0], "zero at the end")


def test_limits_and_slew_hold_for_the_wheels():
    with wheels({"limits.wheel_speed": 0.4}, wheel_sides="'right,left'") as s:
        base = begin(s, crossed=True)
        before = len(base.heard)
        s.base.run(60)
        rim = RADIUS * np.array(base.heard[before:])
        assert np.abs(rim).max() <= 0.4 + 1e-9
        limits, half = CONFIG.limits, 0.5 * CONFIG.wheels.track
        slope = (limits.v_slew + half * limits.omega_slew) * DT
        assert np.abs(np.diff(rim, axis=0)).max() <= slope + 1e-9
        # A left turn: the right wheel, which is named first, is the faster one.
        assert rim[-1, 0] > rim[-1, 1] > 0.0


def test_wheels_without_a_radius_are_refused():
    with pytest.raises(Exception, match="needs wheel_radius"), wheels(wheel_radius=0.0) as s:
        s.node.trigger_configure()
        raise ValueError(s.node.failure)


@pytest.mark.parametrize("sides", ["left", "left,middle", "", "left,left"])
def test_sides_that_are_none_are_refused(sides):
    with pytest.raises(Exception, match="wheel_sides"), wheels(wheel_sides=f"'{sides}'") as s:
        s.node.trigger_configure()
        raise ValueError(s.node.failure)


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
