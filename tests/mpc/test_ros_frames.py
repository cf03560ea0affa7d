"""Poses by /tf and references in other frames, over DDS: a robot between map, odom and base_link."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_parts import CONFIG, DT, Stack
from sensor_msgs.msg import Imu

from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.ros.conversions import stamped_pose_message, time_message
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformBuffer
from diffdrive_mpc.mpc.ros.transforms.rigid import Rigid
from diffdrive_mpc.mpc.step_result import Mode

LIMITS = CONFIG.limits
BRAKING = math.ceil(max(LIMITS.v / LIMITS.v_braking, LIMITS.omega / LIMITS.omega_braking) / DT) + 1
SLEW = np.array([LIMITS.v_slew, LIMITS.omega_slew]) * DT + 1e-9


class Localised:
    """Fake base that publishes transforms as well; the localisation reports `map_to_odom` (3,).

    `published` contains the child frames of the published transforms; `ahead` shifts their stamps [ns].
    """

    def __init__(self, s, message_type, map_to_odom=(0.0, 0.0, 0.0), ahead=0):
        self.s, self.type, self.map_to_odom, self.ahead = s, message_type, map_to_odom, ahead
        self.published = {"odom", "base_link"}
        node = s.base.node
        self.dynamic = node.create_publisher(message_type, "/tf", 100)
        self.static = node.create_publisher(
            message_type, "/tf_static", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        self._publish_sensors = s.base.publish_sensors
        s.base.publish_sensors = self.publish

    def publish(self):
        base = self.s.base
        transforms = []
        if "odom" in self.published:
            transforms.append(transform("map", "odom", base.now + self.ahead, self.map_to_odom))
        if "base_link" in self.published:
            transforms.append(transform("odom", "base_link", base.now, base.plant.true_pose))
        self.dynamic.publish(self.type(transforms=transforms))
        self._publish_sensors()

    def in_map(self):
        """Return the true pose of the robot in the map."""
        return compose(self.map_to_odom, self.s.base.plant.true_pose)


def compose(motion, pose):
    x, y, turn = motion
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([x + cos * pose[0] - sin * pose[1], y + sin * pose[0] + cos * pose[1], turn + pose[2]])


def transform(parent, child, stamp, pose):
    result = TransformStamped(child_frame_id=child)
    result.header.frame_id, result.header.stamp = parent, time_message(stamp)
    message = stamped_pose_message(pose, stamp, parent).pose
    result.transform.translation.x, result.transform.translation.y = message.position.x, message.position.y
    result.transform.rotation = message.orientation
    return result


@pytest.fixture
def localised(ros_types):
    """Factory of robots that are localised by transforms; the node has received the transforms."""
    from tf2_msgs.msg import TFMessage

    stacks = []

    def make(map_to_odom=(0.0, 0.0, 0.0), *, ahead=0, **parameters):
        s = Stack(**parameters)
        stacks.append(s)
        robot = Localised(s, TFMessage, map_to_odom, ahead)
        s.base.until(lambda: (s.base.silent(1), s.node._inbox.frames.accepted > 3)[1], "transforms")
        return robot

    yield make
    for s in stacks:
        s.close()


def straight_path(frame, start, length=2.0, speed=0.4, stamp=0):
    """Return a path from rest to rest along x of `frame`, starting at `start` (3,) there."""
    path = Path()
    path.header.frame_id, path.header.stamp = frame, time_message(stamp)
    duration = 1.5 * length / speed
    for share in np.linspace(0.0, 1.0, 31):
        pose = compose(start, (length * (3 * share**2 - 2 * share**3), 0.0, 0.0))
        path.poses.append(stamped_pose_message(pose, 10**9 + round(share * duration * 1e9), frame))
    return path


def send_path(s, path):
    """Send a path and wait until it is accepted; the next tick drives it."""
    publisher = s.publisher(Path, "set_path")
    s.base.silent(3)
    previous = s.loop._reference
    publisher.publish(path)
    s.base.until(lambda: s.loop._reference is not previous, "the path to be accepted")


def lateral_offset(start, pose):
    """Return the offset of `pose` to the left of the line that starts at `start` (3,) [m]."""
    return -math.sin(start[2]) * (pose[0] - start[0]) + math.cos(start[2]) * (pose[1] - start[1])


def test_poses_from_transforms_drive_the_robot_in_the_map(localised):
    robot = localised((3.0, -2.0, 0.7), pose_source="tf", trajectory="circle", start_at_robot=True)
    s = robot.s
    assert s.trigger("start").success
    s.base.run(150)
    assert s.loop.last.mode == Mode.TRACKING
    np.testing.assert_allclose(s.loop.last.result.estimate.pose[:2], robot.in_map()[:2], atol=0.02)
    start = s.loop.drive.reference.sample([0.0]).pose[0]
    assert abs(wrap_angle(start[2] - 0.7)) < 0.01
    centre = compose(start, (0.0, 1.0, 0.0))[:2]
    assert abs(math.hypot(*(robot.in_map()[:2] - centre)) - 1.0) < 0.02


@pytest.mark.parametrize("missing", ["odom", "base_link"])
def test_missing_transforms_brake_the_robot_until_they_return(localised, missing):
    robot = localised(pose_source="tf", trajectory="circle", start_at_robot=True)
    s = robot.s
    assert s.trigger("start").success
    s.base.run(60)
    robot.published.discard(missing)
    braking = s.base.run(math.ceil(CONFIG.failure.dead_reckoning / DT) + 3)
    assert s.loop.last.mode in (Mode.BRAKING, Mode.STOPPED)
    stopped = s.base.run(BRAKING)
    assert s.loop.last.mode == Mode.STOPPED
    assert "no pose was accepted" in s.loop.last.message
    robot.published.add(missing)
    resumed = s.base.run(60)
    assert s.loop.last.mode == Mode.TRACKING
    assert (np.abs(np.diff(np.vstack([braking, stopped, resumed]), axis=0)) <= SLEW).all()


def test_path_in_the_map_follows_corrections_of_the_localisation(localised):
    """The controller runs in odom; the localisation is corrected slightly, by more than the band, and by 50 m."""
    start = (1.0, 1.0, 0.5)
    robot = localised((1.0, 1.0, 0.5), ahead=10**9, use_tf=True, trajectory="''", drive_on_reference=True)
    s = robot.s
    send_path(s, straight_path("map", start, length=6.0))
    commands = s.base.run(150)
    assert s.loop.last.mode == Mode.TRACKING
    assert abs(lateral_offset(start, robot.in_map())) < 0.01
    first_drive = s.loop.drive
    for correction in (0.05, 0.25):
        x, y, turn = robot.map_to_odom
        robot.map_to_odom = (x - math.sin(turn) * correction, y + math.cos(turn) * correction, turn)
        commands = np.vstack([commands, s.base.run(150)])
        assert s.loop.last.mode == Mode.TRACKING
        assert abs(lateral_offset(start, robot.in_map())) < 0.015
    # The corrections do not restart the drive, and commands satisfy the slew limits.
    assert s.loop.drive is first_drive
    assert s.loop.frame_shifts >= 2
    assert (np.abs(np.diff(commands, axis=0)) <= SLEW).all()
    robot.map_to_odom = (50.0, 0.0, 0.0)
    s.base.run(BRAKING + 30)
    assert s.loop.last.mode == Mode.STOPPED
    assert "from the reference; the limit is" in s.loop.last.message


def test_lost_frame_of_the_path_brakes_the_robot_until_it_returns(localised):
    robot = localised(
        (0.0, 0.3, 0.0), use_tf=True, tf_timeout=0.5, trajectory="''", drive_on_reference=True, diagnostics_rate=20.0
    )
    s = robot.s
    received = s.listen(DiagnosticArray, "/diagnostics")
    send_path(s, straight_path("map", (0.0, 0.3, 0.0), length=4.0))
    s.base.run(60)
    robot.published.discard("odom")
    s.base.run(math.ceil(0.5 / DT) + 2)
    assert s.loop.last.mode == Mode.BRAKING
    assert "the transform of 'map' in 'odom' is 0.5" in s.loop.last.message
    s.base.run(BRAKING)
    assert s.loop.last.mode == Mode.STOPPED
    received.clear()
    s.base.until(lambda: received, "diagnostics")
    assert received[-1].status[0].level == DiagnosticStatus.ERROR
    robot.published.add("odom")
    s.base.run(60)
    assert s.loop.last.mode == Mode.TRACKING


def test_path_in_an_unknown_frame_or_time_is_rejected(localised, capfd):
    robot = localised(use_tf=True, trajectory="circle")
    s = robot.s
    assert s.trigger("start").success
    s.base.run(20)
    publisher = s.publisher(Path, "set_path")
    s.base.run(3)
    for frame, stamp, reason in (
        ("nowhere", 0, "there is no transform of 'nowhere'"),
        ("base_link", s.base.now + 10**9, "after the last transform"),
        ("base_link", 1, "before the first transform"),
        ("", 0, "it has no frame"),
    ):
        capfd.readouterr()
        publisher.publish(straight_path(frame, (0.0, 0.0, 0.0), stamp=stamp))
        s.base.until(lambda reason=reason: reason in capfd.readouterr().err, f"the refusal: {reason}")
        s.base.run(3)
        assert s.loop.drive.reference.name == "circle"
        assert s.loop.state is LoopState.DRIVING


@pytest.mark.parametrize(
    ("mount", "yaw_rate"), [(None, 3.0), ((1.0, 0.0), -3.0), ((math.sqrt(0.5), math.sqrt(0.5)), 2.0)]
)
def test_gyro_axis_is_the_vertical_axis_of_its_frame(mount, yaw_rate):
    """The mounts are unknown, upside down (half a turn about x) and sideways (a quarter turn about x)."""
    inbox = Inbox(NodeSettings(), lambda: 10**9, 0)
    inbox.mounts = TransformBuffer()
    if mount is not None:
        rigid = Rigid(0.1, 0.0, 0.0, mount[0], 0.0, 0.0, mount[1])
        inbox.mounts.insert("base_link", "imu_link", 0, rigid, 0, static=True)
    message = Imu()
    message.header.frame_id, message.header.stamp = "imu_link", time_message(10**9)
    message.angular_velocity.x, message.angular_velocity.y, message.angular_velocity.z = math.nan, 2.0, 3.0
    inbox.receive_imu(message)
    assert inbox.measurement().yaw_rate.value == pytest.approx(yaw_rate)
