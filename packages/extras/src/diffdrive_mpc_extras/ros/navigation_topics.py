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
_NEAREST = 0.05
"""Shorter ranges are invalid [m]; the scanner is inside the hull."""


class TransformSender:
    """Sends odom -> base_link with the odometry, and where wanted map -> odom so that the chain is the true pose.

    Parameters
    ----------
    node
        The robot's node.
    prefix
        Before odom and base_link.
    localised
        Whether map -> odom is sent, as a localisation without error would.

    Raises
    ------
    ValueError
        If tf2_msgs is not installed.
    """

    def __init__(self, node: Node, prefix: str, *, localised: bool) -> None:
        try:
            self._kind: Any = import_module("tf2_msgs.msg").TFMessage
        except ImportError as error:
            raise ValueError("transforms need tf2_msgs, which is not installed; leave --transforms out") from error
        self._odom, self._base, self._localised = prefix + ODOM, prefix + BASE, localised
        self._publisher = node.create_publisher(self._kind, TRANSFORMS, 100)

    def send(self, now: int, origin: int, odometry: FloatArray | None, plant: Plant) -> Iterable[tuple[str, Any]]:
        """Send the transforms with the odometry; see `sim.ros.simulated_base.BaseTopics`."""
        del origin
        if odometry is None:
            return
        in_odom, in_map = _matrix(odometry), _matrix(plant.true_pose)
        sent = [_transform(now, self._odom, self._base, in_odom)]
        if self._localised:
            sent.append(_transform(now, MAP, self._odom, in_map @ np.linalg.inv(in_odom)))
        message = self._kind(transforms=sent)
        self._publisher.publish(message)
        yield TRANSFORMS, message


def _matrix(pose: ArrayLike) -> FloatArray:
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
    """Make the transforms that the settings ask for; raises ValueError if tf2_msgs is not installed."""
    return TransformSender(node, settings.frame_prefix, localised=settings.transforms == "map")


class ScanSender:
    """Topic `scan` of a robot in a world.

    Parameters
    ----------
    node
        Node of the robot.
    plant
        Plant in a world.
    settings
        Settings of the base: prefix of the frame.
    """

    def __init__(self, node: Node, plant: WorldPlant, settings: BaseSettings) -> None:
        self._scanner, self._prefix = Scanner(plant.world), settings.frame_prefix
        self._publisher = node.create_publisher(LaserScan, SCAN, qos_profile_sensor_data)

    def send(self, now: int, origin: int, odometry: FloatArray | None, plant: Plant) -> Iterable[tuple[str, Any]]:
        """Send the scan that has arrived; see `sim.ros.simulated_base.BaseTopics`."""
        del now, odometry
        scan = self._scanner.look(plant.time, plant.true_pose, lambda time: origin + round(1e9 * time))
        if scan is not None:
            if self._prefix:
                messages.set_prefix(scan, self._prefix)
            self._publisher.publish(scan)
            yield self._publisher.topic_name, scan


class Scanner:
    """A planar laser scanner in the middle of the robot, in base_link: obstacles and persons, with noise and latency.

    Parameters
    ----------
    world
        World and settings of the scanner.
    seed
        Seed of the noise, not negative.
    """

    def __init__(self, world: World, seed: int = 0) -> None:
        self._world, self._sight = world, world.sight
        self._random = np.random.default_rng(seed)
        self._next = 0.0
        self._coming: deque[tuple[float, Any]] = deque()

    def look(self, time: float, pose: ArrayLike, stamp: Callable[[float], int]) -> Any:  # noqa: ANN401
        """Look from the true `pose` (3,) if it is time [s] to; the scan that has arrived, None for no news."""
        if time >= self._next - _TIME_TOLERANCE:
            self._next += self._sight.period
            self._coming.append((time + self._sight.latency, self._scan(time, np.asarray(pose, float), stamp(time))))
        arrived = None
        while self._coming and self._coming[0][0] <= time + _TIME_TOLERANCE:
            arrived = self._coming.popleft()[1]
        return arrived

    def _scan(self, time: float, pose: FloatArray, stamp: int) -> Any:  # noqa: ANN401
        sight, standing = self._sight, self._world.shapes(time)
        persons = [(*mover.position(time), mover.radius) for mover in self._world.movers]
        discs = np.vstack([standing.discs, np.reshape(persons, (-1, 3))])
        distances, _ = cast_rays(pose, Shapes(standing.polygons, discs), sight)
        measured = np.maximum(distances + sight.range_sd * self._random.standard_normal(len(distances)), _NEAREST)
        message = LaserScan(
            angle_min=-0.5 * sight.field_of_view,
            angle_max=0.5 * sight.field_of_view,
            angle_increment=sight.field_of_view / (sight.rays - 1),
            scan_time=sight.period,
            range_min=_NEAREST,
            range_max=sight.range,
            ranges=measured.astype(np.float32).tolist(),
        )
        message.header.stamp, message.header.frame_id = messages.time_message(stamp), BASE
        return message
