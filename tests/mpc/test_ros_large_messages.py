"""Messages too long to be used are not read, and what is read is read beside the loop."""

import math
import os
import time
from contextlib import suppress

import pytest
from geometry_msgs.msg import PoseStamped, Transform, Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from rclpy.serialization import serialize_message
from ros_parts import CONFIG, DT, stack
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.ros.conversions import LONGEST_NAME, path_bytes, stamped_pose_message
from diffdrive_mpc.mpc.ros.reference_input import read_path
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.step_result import Mode

PATIENCE = 60.0


def path_of(poses, frame="odom"):
    path = Path(poses=[PoseStamped()] * poses)
    path.header.frame_id = frame
    for pose in path.poses[:1]:
        pose.header.frame_id = frame
    return path


@settings(deadline=None, max_examples=30)
@given(poses=st.integers(0, 50), name=st.integers(0, LONGEST_NAME), other=st.integers(0, LONGEST_NAME))
def test_no_path_that_can_be_used_is_longer_than_its_bound(poses, name, other):
    path = Path(poses=[PoseStamped()] * poses)
    path.header.frame_id = "x" * name
    for pose in path.poses:
        pose.header.frame_id = "y" * other
    assert len(serialize_message(path)) <= path_bytes(poses)


@settings(deadline=None, max_examples=10)
@given(points=st.integers(1, 50))
def test_nor_is_a_trajectory_with_velocities_and_accelerations(points):
    point = MultiDOFJointTrajectoryPoint(transforms=[Transform()], velocities=[Twist()], accelerations=[Twist()])
    message = MultiDOFJointTrajectory(joint_names=["base_link"], points=[point] * points)
    message.header.frame_id = "x" * LONGEST_NAME
    assert len(serialize_message(message)) <= path_bytes(points)


def test_a_path_too_long_is_refused_unread_and_the_robot_drives_on(capfd):
    with stack(drive=True) as s:
        s.base.run(20)
        publisher = s.publisher(Path, "set_path")
        publisher.publish(path_of(20_000))
        s.base.until(lambda: "reference refused: it has 1" in capfd.readouterr().err, "the refusal")
        assert s.base.run(20)[-1, 0] > 0.1
        assert s.loop.state is LoopState.DRIVING
        assert s.loop.begun.reference.name == "circle"


def test_while_a_reference_is_read_the_loop_goes_on():
    with stack(drive=True) as s:
        s.base.run(20)
        before = s.loop.begun
        path = Path()
        path.header.frame_id = "odom"
        x, y, theta = s.base.plant.true_pose
        for index in range(1000):
            along = 0.3 * 0.02 * index
            pose = x + along * math.cos(theta), y + along * math.sin(theta), theta
            path.poses.append(stamped_pose_message(pose, 10**9 + index * 20_000_000, "odom"))
        publisher = s.publisher(Path, "set_path")
        publisher.publish(path)
        s.base.until(lambda: s.node._aside._thread is not None, "the path to arrive")
        # Between its arrival and its acceptance ticks are answered: a process cannot be quicker than to begin.
        s.base.run(3)
        assert s.loop.begun is before
        s.base.until(lambda: s.loop.begun is not before, "the path to be begun")
        s.base.run(2)
        assert s.loop.begun.reference.name == "path"
        s.base.run(40)
        assert s.loop.last.mode == Mode.TRACKING


def long_frame(odometry):
    odometry.header.frame_id = "o" * 10_000_000
    return odometry


def test_odometry_with_a_name_too_long_is_refused_and_at_last_the_robot_brakes():
    with stack(drive=True) as s:
        s.base.run(20)
        s.base.tamper = long_frame
        s.base.run(math.ceil(0.2 / DT) + 3)
        s.base.until(lambda: s.node._inbox.odometry.refused, "a refusal")
        s.base.run(2)
        assert s.loop.last.mode == Mode.BRAKING
        assert "bytes, and none of its kind" in s.loop.last.message
        s.base.tamper = lambda odometry: odometry
        s.base.run(60)
        assert s.loop.last.mode == Mode.TRACKING


class Aside:
    """A side process whose answers are kept, and waited for."""

    def __init__(self, patience=PATIENCE):
        self.done, self.failed = [], []
        self.process = SideProcess(lambda: None, patience)

    def ask(self, key, function, *arguments):
        self.process.submit(key, function, arguments, self.done.append, self.failed.append)

    def wait(self, count):
        end = time.monotonic() + PATIENCE
        while len(self.done) + len(self.failed) < count:
            assert time.monotonic() < end
            time.sleep(0.01)
            self.process.deliver()


@pytest.fixture(scope="module")
def begun():
    """One for several tests: a process takes a second to begin."""
    made = Aside()
    yield made
    made.process.close()


@pytest.fixture
def aside(begun):
    begun.done.clear()
    begun.failed.clear()
    return begun


def test_what_is_wrong_with_a_message_is_said_as_before(aside):
    aside.ask("reference", read_path, bytes(serialize_message(path_of(1))), CONFIG.limits)
    aside.ask("other", read_path, b"\x00\x01\x00\x00" + b"\xff" * 40, CONFIG.limits)
    aside.wait(2)
    assert not aside.done
    assert any("it has 1 poses" in reason for reason in aside.failed)


def test_a_process_that_was_killed_is_replaced(aside):
    aside.ask("a", os.getpid)
    aside.wait(1)
    first = aside.done[0]
    assert first != os.getpid()
    os.kill(first, 9)
    aside.process._process.wait()
    aside.ask("a", os.getpid)
    aside.wait(2)
    assert aside.failed == ["the process that reads it ended; send it again"]
    aside.ask("a", os.getpid)
    aside.wait(3)
    assert aside.done[1] not in (first, os.getpid())


def test_what_takes_too_long_is_given_up():
    aside = Aside(patience=2.0)
    try:
        aside.ask("a", time.sleep, 1000.0)
        aside.wait(1)
        assert aside.failed == ["to read it takes longer than 2 s"]
    finally:
        aside.process.close()


def test_the_newest_of_a_kind_counts(aside):
    aside.ask("first", time.sleep, 0.5)
    for number in range(3):
        aside.ask("a", abs, number)
    aside.wait(4)
    assert aside.done == [None, 2]
    assert aside.failed == ["a newer one came before it was read"] * 2


def test_closed_while_it_works_it_leaves_no_process():
    aside = Aside()
    aside.ask("a", os.getpid)
    aside.wait(1)
    aside.ask("a", time.sleep, 1000.0)
    aside.process.close()
    end = time.monotonic() + PATIENCE
    with suppress(ProcessLookupError):
        while time.monotonic() < end:
            os.kill(aside.done[0], 0)
            aside.process.close()
            time.sleep(0.05)
    assert time.monotonic() < end
    assert not aside.process._thread.is_alive()
