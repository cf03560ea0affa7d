"""A robot behind the topics of a base, in real time, whose messages somebody tampers with."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, PointCloud2, PointField

from diffdrive_mpc.mpc.ros.conversions import pose_message, time_message

PERIOD = 0.02
_LAG = 0.1
# So late that it can be set back without falling below zero [ns].
_EPOCH = 10**15
# A clock that was not published for longer stood [s].
_STANDS = 0.1
# A base stops by itself when commands cease [s].
_COMMAND_TIMEOUT = 0.5

Tamper = Callable[[Any], "list[Any]"]
"""From an honest message to those that are sent instead."""


class Base:
    """Lag and integrator, with perfect sensors. With `sim_time` it publishes the clock, too."""

    def __init__(self, node: Node, *, sim_time: bool) -> None:
        self.node, self.sim_time = node, sim_time
        self.pose, self.twist, self.command = [0.0, 0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self._heard = -math.inf
        self.odom = node.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self.imu = node.create_publisher(Imu, "imu", qos_profile_sensor_data)
        self.pose_topic = node.create_publisher(PoseWithCovarianceStamped, "pose", qos_profile_sensor_data)
        self.clock = node.create_publisher(Clock, "/clock", 10)
        node.create_subscription(TwistStamped, "cmd_vel", self._take, QoSProfile(depth=1))
        self.tamper: dict[str, Tamper] = {}
        # What lies around it: five times a second a free costmap and no obstacles.
        self.costmap = node.create_publisher(OccupancyGrid, "costmap", 1)
        self.obstacles = node.create_publisher(PointCloud2, "obstacles", 1)
        self.frame, self._count = "odom", 0
        # Says where the robot is in /tf, at a time; None: nothing does.
        self.transforms: tuple[Any, Callable[[int, list[float]], Any]] | None = None
        self.held = False
        self.clock_offset, self.clock_stands = 0.0, False
        self._begin = time.monotonic()
        self._next = self._begin
        self._sim_now = _EPOCH
        # From when to when its clock stood, by the monotonic one [s]: no ticks are due then.
        self.stood: list[tuple[float, float]] = []
        self._advanced = self._begin

    @property
    def now(self) -> int:
        """The robot's clock [ns]."""
        return self._sim_now if self.sim_time else time.time_ns()

    def _take(self, message: TwistStamped) -> None:
        self.command, self._heard = [message.twist.linear.x, message.twist.angular.z], time.monotonic()

    def tick_if_due(self) -> None:
        """Move, and say what the sensors see; a base that is late does not hurry."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = max(self._next + PERIOD, now)
        if self.sim_time and not self.clock_stands:
            if now - self._advanced > _STANDS:
                self.stood.append((self._advanced, now))
            self._sim_now, self._advanced = _EPOCH + int(1e9 * (now - self._begin + self.clock_offset)), now
        wanted = self.command if now - self._heard < _COMMAND_TIMEOUT and not self.held else [0.0, 0.0]
        for i in (0, 1):
            self.twist[i] += PERIOD / _LAG * (wanted[i] - self.twist[i])
        heading = self.pose[2] + 0.5 * PERIOD * self.twist[1]
        self.pose[0] += PERIOD * self.twist[0] * math.cos(heading)
        self.pose[1] += PERIOD * self.twist[0] * math.sin(heading)
        self.pose[2] += PERIOD * self.twist[1]
        self.publish()

    def publish(self) -> None:
        """All sensors now, and the clock after them."""
        stamp = time_message(max(self.now, 0))
        odometry = Odometry(child_frame_id="base_link")
        odometry.header.stamp, odometry.header.frame_id = stamp, "odom"
        odometry.pose.pose = pose_message(self.pose)
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = self.twist
        imu = Imu()
        imu.header.stamp, imu.header.frame_id = stamp, "base_link"
        imu.angular_velocity.z = self.twist[1]
        pose = PoseWithCovarianceStamped()
        pose.header.stamp, pose.header.frame_id = stamp, "map"
        pose.pose.pose = pose_message(self.pose)
        for name, publisher, message in (
            ("odom", self.odom, odometry),
            ("imu", self.imu, imu),
            ("pose", self.pose_topic, pose),
        ):
            for one in self.tamper.get(name, lambda honest: [honest])(message):
                publisher.publish(one)
        self._count += 1
        if self._count % 10 == 0:
            self._publish_surroundings(stamp)
        if self.transforms is not None:
            publisher, say = self.transforms
            for one in self.tamper.get("tf", lambda honest: [honest])(say(self.now, self.pose)):
                publisher.publish(one)
        if self.sim_time:
            for one in self.tamper.get("clock", lambda honest: [honest])(Clock(clock=stamp)):
                self.clock.publish(one)

    def _publish_surroundings(self, stamp: Any) -> None:
        grid = OccupancyGrid(data=[0] * 40 * 40)
        grid.header.stamp, grid.header.frame_id = stamp, self.frame
        grid.info.resolution, grid.info.width, grid.info.height = 0.1, 40, 40
        grid.info.origin = pose_message([self.pose[0] - 2.0, self.pose[1] - 2.0, 0.0])
        cloud = disc_cloud([])
        cloud.header.stamp, cloud.header.frame_id = stamp, self.frame
        for name, publisher, message in (("costmap", self.costmap, grid), ("obstacles", self.obstacles, cloud)):
            for one in self.tamper.get(name, lambda honest: [honest])(message):
                publisher.publish(one)


def disc_cloud(discs: list[list[float]]) -> Any:
    """sensor_msgs/PointCloud2 of discs x, y, radius, vx, vy."""
    fields = [
        PointField(name=name, offset=8 * i, datatype=PointField.FLOAT64, count=1)
        for i, name in enumerate(("x", "y", "radius", "vx", "vy"))
    ]
    data = b"".join(struct.pack("<5d", *disc) for disc in discs)
    return PointCloud2(fields=fields, width=len(discs), height=1, point_step=40, row_step=len(data), data=data)
