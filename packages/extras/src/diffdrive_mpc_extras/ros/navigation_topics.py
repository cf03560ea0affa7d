"""Topics of the simulated base for a navigation stack: transforms, and a laser scan of the world."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import ArrayLike
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.drive_log.topics import BASE, MAP, ODOM
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.simulated_base import BaseSettings
from diffdrive_mpc_extras.worlds.shapes import Shapes
from diffdrive_mpc_extras.worlds.sight import cast_rays
from diffdrive_mpc_extras.worlds.world import World
from diffdrive_mpc_extras.worlds.world_plant import WorldPlant

TRANSFORMS, SCAN = "/tf", "scan"
_TIME_TOLERANCE = 1e-9
_MIN_RANGE = 0.05
"""Minimum valid range [m]; the scanner is inside the hull."""


class TransformSender:
    """Publisher of odom -> base_link from the odometry and, on request, of map -> odom from the true pose.

    Parameters
    ----------
    node
        Node of the robot.
    prefix
        Prefix of the frames odom and base_link.
    localised
        True to publish map -> odom such that map -> base_link is the true pose.

    Raises
    ------
    ValueError
        If tf2_msgs is not installed.
    """

    def __init__(self, node: Node, prefix: str, *, localised: bool) -> None:
        try:
            self._message_type: Any = import_module("tf2_msgs.msg").TFMessage
        except ImportError as error:
            raise ValueError("transforms need tf2_msgs, which is not installed; omit --transforms") from error
        self._odom, self._base, self._localised = prefix + ODOM, prefix + BASE, localised
        self._publisher = node.create_publisher(self._message_type, TRANSFORMS, 100)

    def send(self, now: int, origin: int, odometry: FloatArray | None, plant: Plant) -> Iterable[tuple[str, Any]]:
        """Publish the transforms of a new odometry pose; see `sim.ros.simulated_base.BaseTopics`."""
        del origin
        if odometry is None:
            return
        odom_from_base, map_from_base = _matrix(odometry), _matrix(plant.true_pose)
        stamped = [_transform(now, self._odom, self._base, odom_from_base)]
        if self._localised:
            stamped.append(_transform(now, MAP, self._odom, map_from_base @ np.linalg.inv(odom_from_base)))
        message = self._message_type(transforms=stamped)
        self._publisher.publish(message)
        yield TRANSFORMS, message


def _matrix(pose: ArrayLike) -> FloatArray:
    """Return the homogeneous transform (3, 3) of a pose (3,)."""
    x, y, theta = np.asarray(pose, dtype=float)
    cos, sin = np.cos(theta), np.sin(theta)
    return np.array([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])


def _transform(now: int, parent: str, child: str, matrix: FloatArray) -> Any:  # noqa: ANN401
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.header.frame_id = messages.time_message(now), parent
    pose = messages.pose_message((matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0])))
    message.transform.translation.x, message.transform.translation.y = pose.position.x, pose.position.y
    message.transform.rotation = pose.orientation
    return message


def transforms(node: Node, _plant: Plant, settings: BaseSettings) -> TransformSender:
    """Create the sender of transforms for the settings; raises ValueError if tf2_msgs is not installed."""
    return TransformSender(node, settings.frame_prefix, localised=settings.transforms == "map")


class ScanSender:
    """Publisher of the topic `scan` of a robot in a world.

    Parameters
    ----------
    node
        Node of the robot.
    plant
        Plant in a world.
    settings
        Settings of the simulated base, with the frame prefix.
    """

    def __init__(self, node: Node, plant: WorldPlant, settings: BaseSettings) -> None:
        self._scanner, self._prefix = Scanner(plant.world), settings.frame_prefix
        self._publisher = node.create_publisher(LaserScan, SCAN, qos_profile_sensor_data)

    def send(self, now: int, origin: int, odometry: FloatArray | None, plant: Plant) -> Iterable[tuple[str, Any]]:
        """Publish a new scan; see `sim.ros.simulated_base.BaseTopics`."""
        del now, odometry
        scan = self._scanner.scan(plant.time, plant.true_pose, lambda time: origin + round(1e9 * time))
        if scan is not None:
            if self._prefix:
                messages.set_prefix(scan, self._prefix)
            self._publisher.publish(scan)
            yield self._publisher.topic_name, scan


class Scanner:
    """Planar laser scanner at the origin of base_link, with noise and latency; it detects obstacles and persons.

    Parameters
    ----------
    world
        World with the settings of the scanner.
    seed
        Seed of the noise, not negative.
    """

    def __init__(self, world: World, seed: int = 0) -> None:
        self._world, self._sight = world, world.sight
        self._random = np.random.default_rng(seed)
        self._next_time = 0.0
        self._pending: deque[tuple[float, Any]] = deque()

    def scan(self, time: float, pose: ArrayLike, stamp: Callable[[float], int]) -> Any:  # noqa: ANN401
        """Measure from the true `pose` (3,) if a scan is due at `time` [s].

        Return the newest scan that has arrived since the last call, with the time stamp [ns] that `stamp` computes from
        its time [s]; None without a new scan.
        """
        if time >= self._next_time - _TIME_TOLERANCE:
            self._next_time += self._sight.period
            message = self._measure(time, np.asarray(pose, float), stamp(time))
            self._pending.append((time + self._sight.latency, message))
        arrived = None
        while self._pending and self._pending[0][0] <= time + _TIME_TOLERANCE:
            arrived = self._pending.popleft()[1]
        return arrived

    def _measure(self, time: float, pose: FloatArray, stamp: int) -> Any:  # noqa: ANN401
        sight, standing = self._sight, self._world.shapes(time)
        persons = [(*mover.position(time), mover.radius) for mover in self._world.movers]
        discs = np.vstack([standing.discs, np.reshape(persons, (-1, 3))])
        distances, _ = cast_rays(pose, Shapes(standing.polygons, discs), sight)
        ranges = np.maximum(distances + sight.range_sd * self._random.standard_normal(len(distances)), _MIN_RANGE)
        message = LaserScan(
            angle_min=-0.5 * sight.field_of_view,
            angle_max=0.5 * sight.field_of_view,
            angle_increment=sight.field_of_view / (sight.rays - 1),
            scan_time=sight.period,
            range_min=_MIN_RANGE,
            range_max=sight.range,
            ranges=ranges.astype(np.float32).tolist(),
        )
        message.header.stamp, message.header.frame_id = messages.time_message(stamp), BASE
        return message
