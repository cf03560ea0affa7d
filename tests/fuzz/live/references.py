"""References as messages, from good ones to hostile ones, by name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from random import Random
from typing import Any

from geometry_msgs.msg import Transform
from nav_msgs.msg import Path
from rclpy.serialization import serialize_message
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from diffdrive_mpc.mpc.ros.conversions import pose_message, stamped_pose_message, time_message

Row = tuple[float, float, float, float]
"""Time [s], x, y [m], theta [rad]."""


def rows(name: str, random: Random, pose: Sequence[float]) -> list[Row]:
    """Rows of a reference that begins at `pose` (3,)."""
    x, y, theta = pose
    c, s = math.cos(theta), math.sin(theta)

    def straight(count: int, period: float, speed: float) -> list[Row]:
        along = [speed * period * i for i in range(count)]
        return [(period * i, x + c * d, y + s * d, theta) for i, d in enumerate(along)]

    bases = {
        "straight": straight(20, 0.2, 0.3),
        "long": straight(1000, 0.1, 0.2),
        "too long": straight(1001, 0.1, 0.2),
        "much too long": straight(20_000, 0.01, 0.2),
        "standing": straight(20, 0.2, 0.0),
        "two": straight(2, 0.5, 0.2),
        "a moment": straight(2, 1e-3, 0.0),
        "empty": [],
        "one": straight(1, 1.0, 0.0),
        "too fast": straight(20, 0.2, 30.0),
        "slow": straight(10, 1e6, 1e-6),
        "equal times": [(1.0, *row[1:]) for row in straight(20, 0.2, 0.3)],
        "backwards in time": straight(20, 0.2, 0.3)[::-1],
        "not a number": [
            (t, math.nan if i == 7 else a, b, th) for i, (t, a, b, th) in enumerate(straight(20, 0.2, 0.3))
        ],
        "infinite": [(t, a, math.inf if i == 7 else b, th) for i, (t, a, b, th) in enumerate(straight(20, 0.2, 0.3))],
        "far": [(t, a + 1e12, b, th) for t, a, b, th in straight(20, 0.2, 0.3)],
        "elsewhere": [(t, a + 5.0, b, th) for t, a, b, th in straight(20, 0.2, 0.3)],
        "sideways": [(t, a, b, th + 1.5) for t, a, b, th in straight(20, 0.2, 0.3)],
        "zigzag": [(t, a, b + 0.2 * (-1) ** i, th) for i, (t, a, b, th) in enumerate(straight(20, 0.2, 0.3))],
        "random": [
            (0.3 * i, x + random.gauss(0, 0.5), y + random.gauss(0, 0.5), random.uniform(-4, 4)) for i in range(10)
        ],
        "cusp": [
            *straight(10, 0.2, 0.3),
            *[(2.0 + 0.2 * i, *row[1:]) for i, row in enumerate(straight(10, 0.2, 0.3)[::-1])],
        ],
    }
    return bases[name]


NAMES = (
    "straight",
    "straight",
    "straight",
    "long",
    "too long",
    "much too long",
    "standing",
    "two",
    "a moment",
    "empty",
    "one",
    "too fast",
    "slow",
    "equal times",
    "backwards in time",
    "not a number",
    "infinite",
    "far",
    "elsewhere",
    "sideways",
    "zigzag",
    "random",
    "cusp",
)


def path_message(table: list[Row], frame: str, now: int) -> Any:
    """nav_msgs/Path."""
    poses = [stamped_pose_message((x, y, th), _clipped(now + int(1e9 * t)), frame) for t, x, y, th in table]
    message = Path(poses=poses)
    message.header.frame_id = frame
    return message


def trajectory_message(table: list[Row], frame: str, transforms: int = 1) -> Any:
    """trajectory_msgs/MultiDOFJointTrajectory, with so many transforms in each point."""
    message = MultiDOFJointTrajectory()
    message.header.frame_id = frame
    for t, x, y, th in table:
        pose = pose_message((x, y, th))
        one = Transform(rotation=pose.orientation)
        one.translation.x, one.translation.y = pose.position.x, pose.position.y
        point = MultiDOFJointTrajectoryPoint(transforms=[one] * transforms)
        stamp = time_message(_clipped(int(1e9 * t)))
        point.time_from_start.sec, point.time_from_start.nanosec = stamp.sec, stamp.nanosec
        message.points.append(point)
    return message


def spoilt(message: Any, random: Random) -> bytes:
    """The message as bytes, some of which are wrong."""
    content = bytearray(serialize_message(message))
    way = random.randrange(3)
    if way == 0:
        return bytes(content[: random.randrange(len(content))])
    for _ in range(random.choice((1, 8, 64))):
        content[random.randrange(4 if way == 1 else 0, len(content))] = random.randrange(256)
    return bytes(content)


def _clipped(time: int) -> int:
    return min(max(time, 0), (2**31 - 1) * 10**9)
