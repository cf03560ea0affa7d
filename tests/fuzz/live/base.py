"""Simulated base on the topics of the node, in real time, with changes of its sensor messages."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from random import Random
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from diffdrive_mpc.mpc.ros.conversions import nanoseconds, pose_message, time_message
from fuzz import odd
from fuzz.live.judge import Heard

PERIOD = 0.02
_LAG = 0.1
_EPOCH = 10**15
"""Start of the simulated clock [ns], late enough to be set back without falling below zero."""
_MAX_CLOCK_GAP = 0.1
"""A simulated clock that is not published for longer stands [s]."""
_COMMAND_TIMEOUT = 0.5

Change = Callable[[Any], "list[Any]"]
"""Map a correct message to the messages that are sent."""


class Base:
    """Lag and integrator with exact sensors; with `sim_time` it also publishes the clock."""

    def __init__(self, node: Node, *, sim_time: bool) -> None:
        self.sim_time = sim_time
        self.pose, self.twist, self.command = [0.0, 0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self.commands: list[Heard] = []
        self.changes: dict[str, Change] = {}
        self.blocked = False
        self.clock_offset, self.clock_stands = 0.0, False
        self.standing: list[tuple[float, float]] = []
        """Intervals of the monotonic clock in which the simulated clock stands [s]."""
        self._publishers = {
            name: node.create_publisher(kind, name, qos_profile_sensor_data)
            for name, kind in (("odom", Odometry), ("imu", Imu), ("pose", PoseWithCovarianceStamped))
        }
        self._clock = node.create_publisher(Clock, "/clock", 10)
        node.create_subscription(TwistStamped, "cmd_vel", self._take, QoSProfile(depth=1000))
        self._heard, self._sim_now = -math.inf, _EPOCH
        self._start = self._next = self._advanced = time.monotonic()

    @property
    def now(self) -> int:
        """Time of the clock of the robot [ns]."""
        return self._sim_now if self.sim_time else time.time_ns()

    def _take(self, message: TwistStamped, info: dict[str, Any]) -> None:
        twist, self._heard = message.twist, time.monotonic()
        self.command = [twist.linear.x, twist.angular.z]
        rest = any((twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y))
        self.commands.append(Heard(self._heard, *self.command, info.get("publication_sequence_number"), rest))

    def tick_if_due(self) -> None:
        """Move and publish the sensors; a late base does not catch up."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = max(self._next + PERIOD, now)
        if self.sim_time and not self.clock_stands:
            if now - self._advanced > _MAX_CLOCK_GAP:
                self.standing.append((self._advanced, now))
            self._sim_now, self._advanced = _EPOCH + int(1e9 * (now - self._start + self.clock_offset)), now
        target = self.command if now - self._heard < _COMMAND_TIMEOUT and not self.blocked else [0.0, 0.0]
        for i in (0, 1):
            self.twist[i] += PERIOD / _LAG * (target[i] - self.twist[i])
        heading = self.pose[2] + 0.5 * PERIOD * self.twist[1]
        self.pose[0] += PERIOD * self.twist[0] * math.cos(heading)
        self.pose[1] += PERIOD * self.twist[0] * math.sin(heading)
        self.pose[2] += PERIOD * self.twist[1]
        self._publish()

    def _publish(self) -> None:
        messages = {"odom": Odometry(child_frame_id="base_link"), "imu": Imu(), "pose": PoseWithCovarianceStamped()}
        for (name, message), frame in zip(messages.items(), ("odom", "base_link", "map"), strict=True):
            message.header.stamp, message.header.frame_id = time_message(max(self.now, 0)), frame
            if name != "imu":
                message.pose.pose = pose_message(self.pose)
        messages["odom"].twist.twist.linear.x, messages["odom"].twist.twist.angular.z = self.twist
        messages["imu"].angular_velocity.z = self.twist[1]
        for name, message in messages.items():
            for sent in self.changes[name](message) if name in self.changes else [message]:
                self._publishers[name].publish(sent)
        if self.sim_time:
            self._clock.publish(Clock(clock=time_message(max(self.now, 0))))


def make_change(name: str, random: Random) -> Change:
    """Return the change `name`, which draws from `random`."""
    start: list[int] = []

    def change(message: Any) -> list[Any]:
        stamp = nanoseconds(message.header.stamp)
        start.append(stamp)
        if name in VALUES:
            _set_value(message, VALUES[name])
        elif name == "noisy":
            _set_value(message, odd.near(0.1, random))
        elif name in SHIFTS or name == "mixed stamps":
            seconds = SHIFTS[name] if name in SHIFTS else random.choice((0.0, -0.02, 0.1, 0.21, 10.0, -1e9, 1e9))
            message.header.stamp = time_message(min(max(stamp + int(1e9 * seconds), 0), (2**31 - 1) * 10**9))
        elif name == "backwards":
            message.header.stamp = time_message(max(2 * start[0] - stamp, 0))
        elif name == "other frame":
            message.header.frame_id = "elsewhere"
        elif name == "no orientation" and hasattr(message, "pose"):
            message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        elif name == "covariance" and hasattr(message, "pose"):
            message.pose.covariance = [odd.number(random) for _ in range(36)]
        elif name == "flood":
            return [copy.deepcopy(message) for _ in range(100)]
        elif name == "garbage":
            return [damaged(message, random)]
        return [] if name == "lost" else [message]

    return change


def _set_value(message: Any, value: float) -> None:
    if hasattr(message, "pose"):
        message.pose.pose.position.x = value
    if hasattr(message, "twist"):
        message.twist.twist.linear.x = value
    if hasattr(message, "angular_velocity"):
        message.angular_velocity.z = value


def damaged(message: Any, random: Random) -> bytes:
    """Return the serialised message cut off, with wrong bytes, or with a wrong length of a sequence."""
    content = bytearray(serialize_message(message))
    kind = random.randrange(3)
    if kind == 0:
        return bytes(content[: random.randrange(len(content))])
    if kind == 1:
        for _ in range(random.choice((1, 4, 20))):
            content[random.randrange(len(content))] = random.randrange(256)
    else:
        place = 4 * random.randrange(1, max(2, len(content) // 4))
        content[place : place + 4] = random.choice((b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x10"))
    return bytes(content)


VALUES = {"not a number": math.nan, "infinite": math.inf, "huge": 1e300}
SHIFTS = {"an hour ago": -3600.0, "far ahead": 1000.0, "a little ahead": 0.15, "no stamp": -1e18, "latest stamp": 1e10}
BLINDING = ("lost", "not a number", "infinite", "other frame", "an hour ago", "far ahead", "no stamp", "backwards")
"""Changes that leave no usable message."""
CHANGES = (*BLINDING, "huge", "noisy", "a little ahead", "latest stamp", "mixed stamps")
CHANGES += ("no orientation", "covariance", "flood", "garbage")
