"""Process of the monitor between a controller and a base over DDS: faults, resets and killed processes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from ros_parts import DT, START, FakeBase
from sensor_msgs.msg import Imu
from std_msgs.msg import String
from std_srvs.srv import Trigger

from diffdrive_mpc.mpc.ros.conversions import stamped_pose_message, time_message

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SPEED = 0.4


class FaultyController:
    """Faulty controller on the thread of the base, with a straight reference."""

    def __init__(self, base):
        self.base, self.node = base, base.node
        self.commands = self.node.create_publisher(TwistStamped, "cmd_vel_unchecked", QoSProfile(depth=1))
        self.path = self.node.create_publisher(PathMessage, "diffdrive_mpc/reference_path", LATCHED)
        self.mode = self.node.create_publisher(String, "diffdrive_mpc/mode", LATCHED)
        self.state = []
        self.node.create_subscription(String, "monitor/state", lambda message: self.state.append(message.data), LATCHED)
        self.v = 0.0

    def announce(self, duration=20.0):
        path = PathMessage()
        path.header.frame_id = "odom"
        x = self.base.plant.true_pose[0]
        for k in range(round(20 * duration) + 1):
            stamp = self.base.now + k * 50_000_000
            path.poses.append(stamped_pose_message((x + SPEED * 0.05 * k, 0.0, 0.0), stamp, "odom"))
        self.path.publish(path)
        self.mode.publish(String(data="TRACKING"))

    def send(self, v, omega=0.0, stamp=None):
        message = TwistStamped()
        message.header.stamp = time_message(self.base.now if stamp is None else stamp)
        message.twist.linear.x, message.twist.angular.z = v, omega
        self.commands.publish(message)


class Scene:
    """Base, faulty controller and process of the monitor, in simulated time."""

    def __init__(self, *args):
        self.process = subprocess.Popen(
            [COMMAND, "monitor", "--ros-args", "-p", "use_sim_time:=true", *args], stderr=subprocess.PIPE, text=True
        )
        self.base = FakeBase(lambda: time.sleep(0.001))
        self.controller = FaultyController(self.base)
        self.base.until(self.connected, "the monitor")
        for _ in range(25):  # discovery may be incomplete on the other side
            self.connected()
            time.sleep(0.01)

    def connected(self):
        assert self.process.poll() is None, self.process.stderr.read()
        self.base.silent(1)
        self.controller.send(0.0)
        base, controller = self.base, self.controller
        readers = (base.odom, base.imu, base.clock, controller.path, controller.mode)
        return base.commands and controller.state and all(reader.get_subscription_count() for reader in readers)

    def step(self, v=None, omega=0.0, stamp=None):
        """Simulate a tick with sensors, clock and an optional command; return the resulting command of the base."""
        base, count = self.base, len(self.base.commands)
        base.advance_clock()
        for _ in range(5):
            base.spin()
        if v is not None:
            self.controller.send(v, omega, stamp)
            base.until(lambda: len(base.commands) > count, "a command of the monitor")
        for _ in range(3):
            base.spin()
        base.plant.advance(base.commands[-1])
        return base.commands[-1]

    def drive(self, seconds):
        """Drive without faults."""
        for _ in range(round(seconds / DT)):
            self.controller.v = min(SPEED, self.controller.v + 1.5 * DT)
            self.step(self.controller.v)

    def until_stopped(self, **command):
        for _ in range(250):
            self.step(**command)
            if self.state_text.startswith("STOPPED"):
                break
        for _ in range(40):
            self.step(**command)
        assert self.base.commands[-1] == (0.0, 0.0)
        assert np.isfinite(self.base.commands).all()
        return self.state_text

    @property
    def state_text(self):
        return self.controller.state[-1]

    def reset(self):
        client = self.base.node.create_client(Trigger, "monitor/reset")
        self.base.until(client.service_is_ready, "the service")
        future = client.call_async(Trigger.Request())
        self.base.until(future.done, "its response")
        return future.result()

    def close(self):
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()
        self.base.close()


@pytest.fixture
def scene():
    new_scene = Scene()
    try:
        new_scene.controller.announce()
        new_scene.drive(1.5)
        assert new_scene.state_text == "PASSING"
        assert new_scene.base.commands[-1] == (SPEED, 0.0)
        yield new_scene
    finally:
        new_scene.close()


def test_faults_stop_the_robot_until_a_reset(scene):
    """Check message, persistent stop and reset of several faults in one process."""
    for command, message in (
        ({"v": float("nan")}, "a command is not finite"),
        ({"v": 0.9, "omega": 0.0}, "v of the commands jumps"),
        ({}, "no command while the robot moves"),
        ({"v": SPEED, "stamp": START}, "a command is old"),
    ):
        assert message in scene.until_stopped(**command)
        # No command resumes the drive, and a reset fails while commands move the robot.
        assert scene.step(0.2) == (0.0, 0.0)
        response = scene.reset()
        assert not response.success and "commands still move the robot" in response.message
        for _ in range(20):
            scene.step(0.0)
        assert scene.reset().success
        scene.controller.v = 0.0
        scene.controller.announce()
        scene.drive(1.0)
        assert scene.state_text == "PASSING" and scene.base.commands[-1] == (SPEED, 0.0)


def test_second_publisher_of_commands_stops_the_robot(scene):
    second_publisher = scene.base.node.create_publisher(TwistStamped, "cmd_vel", QoSProfile(depth=1))
    deadline = time.monotonic() + 30.0
    while not scene.state_text.startswith("STOPPED"):
        assert time.monotonic() < deadline
        scene.step(SPEED)
    assert "another node commands the base" in scene.state_text
    scene.base.node.destroy_publisher(second_publisher)


@pytest.mark.parametrize("topic", ["odom", "imu", "cmd_vel_unchecked"])
def test_second_publisher_on_an_input_stops_the_robot(scene, topic):
    """A second publisher without messages does not stop the robot."""
    message_type, qos = {"odom": (Odometry, qos_profile_sensor_data), "imu": (Imu, qos_profile_sensor_data)}.get(
        topic, (TwistStamped, QoSProfile(depth=1))
    )
    second_publisher = scene.base.node.create_publisher(message_type, topic, qos)
    scene.base.until(lambda: second_publisher.get_subscription_count() == 1, "the monitor's subscription")
    scene.drive(0.5)
    assert scene.state_text == "PASSING"
    for _ in range(4):
        message = message_type()
        message.header.stamp = time_message(scene.base.now)
        if message_type is TwistStamped:
            message.twist.linear.x = SPEED
        second_publisher.publish(message)
        scene.step(SPEED)
    assert f"publishes an input (two publishers on /{topic})" in scene.until_stopped(v=SPEED)
    scene.base.node.destroy_publisher(second_publisher)


@pytest.mark.parametrize("signal_number", [signal.SIGTERM, signal.SIGKILL])
def test_no_command_passes_after_the_monitor_ends(scene, signal_number):
    """A terminated monitor sends zero; after a kill only the timeout of the base stops the robot."""
    scene.process.send_signal(signal_number)
    scene.process.wait()
    for _ in range(20):
        scene.base.spin()
    count = len(scene.base.commands)
    assert scene.base.commands[-1] == ((0.0, 0.0) if signal_number == signal.SIGTERM else (SPEED, 0.0))
    for _ in range(10):
        scene.base.plant.advance(scene.base.commands[-1])
        scene.base.advance_clock()
        scene.controller.send(SPEED)
        for _ in range(5):
            scene.base.spin()
    assert len(scene.base.commands) == count


def test_invalid_input_ends_with_a_one_line_error():
    for args, line in (
        (["--rules", "defualt"], "unknown rules 'defualt'"),
        (["--ros-args", "-p", "rules:=nowhere.yaml"], "unknown rules 'nowhere.yaml'"),
        (["--rls", "default"], "unknown argument '--rls'"),
    ):
        result = subprocess.run([COMMAND, "monitor", *args], capture_output=True, text=True, timeout=60, check=False)
        errors = [text for text in result.stderr.splitlines() if text.startswith("error: ")]
        assert result.returncode == 2 and len(errors) == 1 and line in errors[0], result.stderr
