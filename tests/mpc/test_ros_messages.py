"""Messages: contents, conversions, size limits, the side process, and detection of second publishers."""

import math
import os
import signal
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion
from hypothesis import given, settings
from hypothesis import strategies as st
from message_streams import RESERVED, delay_of, restarts, twins, without_numbers
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import serialize_message
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import Float64MultiArray

from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.ros.conversions import (
    MAX_NAME_LENGTH,
    MessageError,
    measured_pose,
    nanoseconds,
    path_bytes,
    pose_message,
    stamped_pose_message,
    time_message,
    yaw_of,
)
from diffdrive_mpc.mpc.ros.diagnostics import diagnostics
from diffdrive_mpc.mpc.ros.message_series import MessageSeries
from diffdrive_mpc.mpc.ros.reference_input import timed_trajectory_reference
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.trajectories import load_trajectory

RADIUS = 0.0675


def stamped_points(frame="odom", last_frame="odom"):
    """Return a trajectory whose points have headers, as in nav_msgs/Trajectory: 1 m ahead in 4 s."""
    times = np.linspace(0.0, 4.0, 21)
    x = 0.5 - 0.5 * np.cos(np.pi * times / 4.0)
    points = [
        SimpleNamespace(
            header=SimpleNamespace(stamp=time_message(10**12 + round(1e9 * t)), frame_id=frame),
            pose=pose_message((position, 0.0, 0.0)),
        )
        for t, position in zip(times, x, strict=True)
    ]
    points[-1].header.frame_id = last_frame
    return SimpleNamespace(header=SimpleNamespace(stamp=time_message(0), frame_id=frame), points=points)


def test_trajectory_with_stamped_points_is_read():
    reference = timed_trajectory_reference(stamped_points(), Limits())
    assert reference.duration == pytest.approx(4.0)
    np.testing.assert_allclose(reference.sample([2.0]).pose[0], (0.5, 0.0, 0.0), atol=1e-3)


def test_point_in_another_frame_raises_error():
    with pytest.raises(MessageError, match="point 20 is in 'map', the trajectory in 'odom'"):
        timed_trajectory_reference(stamped_points(last_frame="map"), Limits())


def test_estimate_is_published_with_frames_and_covariance():
    with stack(drive=True) as s:
        received = s.listen(Odometry, "/diffdrive_mpc/estimate")
        s.base.until(lambda: s.base.silent(1) is not None and received, "the estimate")
        s.base.run(80)
        s.base.until(lambda: nanoseconds(received[-1].header.stamp) == s.base.now, "the estimate of the last tick")
        message, estimate = received[-1], s.loop.last.result.estimate
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        pose = message.pose.pose
        published = (pose.position.x, pose.position.y, yaw_of(pose.orientation))
        np.testing.assert_allclose(published, estimate.pose, atol=1e-9)
        np.testing.assert_allclose((message.twist.twist.linear.x, message.twist.twist.angular.z), estimate.twist)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        np.testing.assert_allclose(np.diag(covariance)[[0, 1, 5]], estimate.pose_deviation**2)
        assert np.diag(covariance)[[0, 1, 5]].min() > 0.0
        assert np.count_nonzero(covariance) == 3
        # The estimate precedes the last command; the plant is one tick ahead.
        np.testing.assert_allclose(published[:2], s.base.plant.true_pose[:2], atol=0.03)


def twist_of_wheels(speeds, track):
    left_speed, right_speed = RADIUS * speeds[0], RADIUS * speeds[1]
    return 0.5 * (left_speed + right_speed), (right_speed - left_speed) / track


class WheelBase:
    """Stack whose base accepts wheel speeds instead of twists."""

    def __init__(self, s, *, swapped=False):
        self.s, self.received, self.swapped = s, [], swapped
        s.base.node.create_subscription(Float64MultiArray, "wheel_commands", self.take, 1)

    def take(self, message):
        self.received.append(list(message.data))
        self.s.base.commands.append(twist_of_wheels(message.data[:: -1 if self.swapped else 1], CONFIG.wheels.track))
        self.s.base.times.append(self.s.base.now)


def wheel_stack(overrides=None, **parameters):
    return stack(overrides, **{"command_output": "wheels", "wheel_radius": RADIUS, "autostart": False, **parameters})


def start_driving(s, *, swapped=False):
    """Activate the node and start the drive; the base receives wheel speeds."""
    base = WheelBase(s, swapped=swapped)
    s.node.trigger_configure()
    s.node.trigger_activate()
    s.await_inputs()
    assert s.trigger("start").success
    return base


def test_wheel_speeds_drive_a_base_without_twist_commands():
    with wheel_stack() as s:
        base = start_driving(s)
        s.base.run(100)
        assert s.loop.last.mode == Mode.TRACKING
        assert s.base.plant.true_pose[0] > 0.3
        np.testing.assert_allclose(s.base.commands[-1], s.loop.last.command, atol=1e-12)
        assert not s.node.count_publishers("/cmd_vel")
        s.node.trigger_deactivate()
        s.base.until(lambda: base.received[-1] == [0.0, 0.0], "zero at the end")


def test_wheel_speeds_satisfy_limits_and_slew():
    with wheel_stack({"limits.wheel_speed": 0.4}, wheel_sides="'right,left'") as s:
        base = start_driving(s, swapped=True)
        count = len(base.received)
        s.base.run(60)
        wheel_speeds = RADIUS * np.array(base.received[count:])
        assert np.abs(wheel_speeds).max() <= 0.4 + 1e-9
        limits, half = CONFIG.limits, 0.5 * CONFIG.wheels.track
        max_slew = (limits.v_slew + half * limits.omega_slew) * DT
        assert np.abs(np.diff(wheel_speeds, axis=0)).max() <= max_slew + 1e-9
        # In a left turn the right wheel, which is first in the message, is faster.
        assert wheel_speeds[-1, 0] > wheel_speeds[-1, 1] > 0.0


@pytest.mark.parametrize("sides", ["left", "left,middle", "", "left,left"])
def test_wrong_wheel_sides_raise_error(sides):
    with pytest.raises(Exception, match="wheel_sides"), wheel_stack(wheel_sides=f"'{sides}'") as s:
        s.node.trigger_configure()
        raise ValueError(s.node.failure)


ANGLES = st.floats(-10, 10)


@given(ANGLES, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_yaw_is_the_direction_of_the_x_axis_in_the_plane(yaw, pitch, roll):
    """The quaternion is the product of rotations about z, y and x; its x axis has the yaw and pitch (yaw, -pitch)."""

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
def test_invalid_quaternion_raises_error(q):
    with pytest.raises(MessageError, match="not a unit quaternion"):
        yaw_of(q)


def test_pose_covariance_is_the_planar_part_and_zero_means_unknown():
    message = PoseWithCovarianceStamped()
    assert measured_pose(message, 0, covariance=True).covariance is None
    message.pose.covariance = [float(index) for index in range(36)]
    expected = [[0, 1, 5], [6, 7, 11], [30, 31, 35]]
    np.testing.assert_array_equal(measured_pose(message, 0, covariance=True).covariance, expected)
    assert measured_pose(message, 0, covariance=False).covariance is None


# Long messages and the side process that converts them.

TIMEOUT = 60.0


def path_of(poses, frame="odom"):
    path = Path(poses=[PoseStamped()] * poses)
    path.header.frame_id = frame
    for pose in path.poses[:1]:
        pose.header.frame_id = frame
    return path


@settings(deadline=None, max_examples=30)
@given(poses=st.integers(0, 50), name=st.integers(0, MAX_NAME_LENGTH), frame_length=st.integers(0, MAX_NAME_LENGTH))
def test_bound_of_bytes_covers_every_usable_path(poses, name, frame_length):
    path = Path(poses=[PoseStamped()] * poses)
    path.header.frame_id = "x" * name
    for pose in path.poses:
        pose.header.frame_id = "y" * frame_length
    assert len(serialize_message(path)) <= path_bytes(poses)


def test_too_long_path_is_rejected_without_stopping_the_robot(capfd):
    with stack(drive=True) as s:
        s.base.run(20)
        publisher = s.publisher(Path, "set_path")
        publisher.publish(path_of(20_000))
        s.base.until(lambda: "reference refused: it has 1" in capfd.readouterr().err, "the refusal")
        assert s.base.run(20)[-1, 0] > 0.1
        assert s.loop.state is LoopState.DRIVING
        assert s.loop.drive.reference.name == "circle"


def test_rejected_reference_is_a_warning_until_another_is_accepted():
    with stack() as s:
        s.base.silent(2)

        def status():
            return diagnostics("robot", 0, "active", s.loop, s.node.parts.values()).status[0]

        assert (status().level, status().message) == (DiagnosticStatus.OK, "IDLE")
        publisher = s.publisher(Path, "set_path")
        publisher.publish(path_of(1))
        s.base.until(lambda: s.base.silent(1) and s.loop.refusal, "the refusal")
        assert status().level == DiagnosticStatus.WARN
        assert status().message == "IDLE: reference refused: it has 1 poses; give 2 to 1000"
        s.loop.set_reference(load_trajectory("circle"))
        assert (status().level, status().message) == (DiagnosticStatus.OK, "IDLE")


def test_control_loop_runs_while_a_reference_is_read():
    with stack(drive=True) as s:
        s.base.run(20)
        drive = s.loop.drive
        path = Path()
        path.header.frame_id = "odom"
        x, y, theta = s.base.plant.true_pose
        for index in range(1000):
            pose = x + 0.006 * index * math.cos(theta), y + 0.006 * index * math.sin(theta), theta
            path.poses.append(stamped_pose_message(pose, 10**9 + index * 20_000_000, "odom"))
        publisher = s.publisher(Path, "set_path")
        publisher.publish(path)
        s.base.until(lambda: s.node._worker._process is not None, "the path to arrive")
        # Ticks continue while the reading process is stopped.
        os.kill(s.node._worker._process.pid, signal.SIGSTOP)
        s.base.run(3)
        assert s.loop.drive is drive
        os.kill(s.node._worker._process.pid, signal.SIGCONT)
        s.base.until(lambda: s.loop.drive is not drive, "the start of the path")
        s.base.run(2)
        assert s.loop.drive.reference.name == "path"
        s.base.run(40)
        assert s.loop.last.mode == Mode.TRACKING


def long_frame(odometry):
    odometry.header.frame_id = "o" * 10_000_000
    return odometry


def test_odometry_with_a_too_long_name_is_rejected_and_the_robot_brakes():
    with stack(drive=True) as s:
        s.base.run(20)
        s.base.tamper = long_frame
        s.base.run(math.ceil(0.2 / DT) + 3)
        assert s.loop.last.mode == Mode.BRAKING
        # Best-effort QoS may lose a fragmented message: send until one arrives.
        for _ in range(200):
            if s.node._inbox.odometry.refused:
                break
            s.base.run(1)
        s.base.run(2)
        # The robot may have come to rest by then.
        assert s.loop.last.mode in {Mode.BRAKING, Mode.STOPPED}
        assert "bytes, the maximum for its type" in s.loop.last.message
        s.base.tamper = lambda odometry: odometry
        s.base.run(60)
        assert s.loop.last.mode == Mode.TRACKING


class RecordedProcess:
    """Side process with records of its responses."""

    def __init__(self, timeout=TIMEOUT):
        self.done, self.failed = [], []
        self.process = SideProcess(lambda: None, timeout)

    def submit(self, key, function, *arguments):
        self.process.submit(key, function, arguments, self.done.append, self.failed.append)

    def wait(self, count):
        deadline = time.monotonic() + TIMEOUT
        while len(self.done) + len(self.failed) < count:
            assert time.monotonic() < deadline
            time.sleep(0.01)
            self.process.deliver()


@pytest.fixture(scope="module")
def started_process():
    """Side process for several tests: its start takes a second."""
    process = RecordedProcess()
    yield process
    process.process.close()


@pytest.fixture
def side_process(started_process):
    started_process.done.clear()
    started_process.failed.clear()
    return started_process


def test_killed_side_process_is_replaced(side_process):
    side_process.submit("a", os.getpid)
    side_process.wait(1)
    first = side_process.done[0]
    assert first != os.getpid()
    os.kill(first, 9)
    side_process.process._process.wait()
    side_process.submit("a", os.getpid)
    side_process.wait(2)
    assert side_process.failed == ["the process that converts it ended; send it again"]
    side_process.submit("a", os.getpid)
    side_process.wait(3)
    assert side_process.done[1] not in (first, os.getpid())


def test_closing_a_busy_side_process_ends_it():
    side_process = RecordedProcess()
    side_process.submit("a", os.getpid)
    side_process.wait(1)
    side_process.submit("a", time.sleep, 1000.0)
    side_process.process.close()
    deadline = time.monotonic() + TIMEOUT
    with suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.kill(side_process.done[0], 0)
            side_process.process.close()
            time.sleep(0.05)
    assert time.monotonic() < deadline
    assert not side_process.process._thread.is_alive()


# Detection of two active publishers on one topic, with random streams of messages.


def detection_time(messages, series=None):
    """Return the time of detection of a second publisher [s], or None without detection."""
    series = series or MessageSeries()
    for arrival, number, stamp in sorted(messages, key=lambda message: message.arrival):
        series.add(number, stamp, arrival)
        if series.is_shared:
            return arrival
    return None


LONG = pytest.param(1000, marks=pytest.mark.long)


@pytest.mark.parametrize("count", [60, LONG])
def test_second_publisher_is_detected_within_the_bound(count):
    delays = np.array([delay_of(detection_time, seed) for seed in range(RESERVED, RESERVED + count)])
    assert np.isfinite(delays).all()
    assert np.mean(delays > 0.0) <= 0.01, delays[delays > 0.0]


@pytest.mark.parametrize("count", [15, LONG])
def test_restarts_are_detected_as_one_publisher(count):
    """At most one false alarm in 10,000 restarts, 50 per seed, with up to 5 % of the messages out of order."""
    alarms = [seed for seed in range(RESERVED, RESERVED + count) if detection_time(restarts(seed)) is not None]
    assert len(alarms) <= count * 50 // 10_000, alarms


@pytest.mark.parametrize("kind", ["none", "zero", "constant"])
def test_messages_without_numbers_are_reported_as_unnumbered(kind):
    series = MessageSeries()
    messages = [message for messages in twins(RESERVED) for message in messages]
    assert detection_time(without_numbers(messages, kind), series) is None
    assert not series.is_numbered
    assert detection_time(messages, MessageSeries()) is not None
