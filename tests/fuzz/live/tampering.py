"""What may happen to a message between a sensor and the node, by name."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from random import Random
from typing import Any

from rclpy.serialization import serialize_message

from diffdrive_mpc.mpc.ros.conversions import nanoseconds, time_message
from fuzz import odd

Change = Callable[[Any], "list[Any]"]


def make(name: str, random: Random) -> Change:
    """The change `name`; what it draws comes from `random`."""
    return _CHANGES[name](random)


def _each(change: Callable[[Any], None]) -> Callable[[Random], Change]:
    """A change in place."""

    def make_it(random: Random) -> Change:
        def apply(message: Any) -> list[Any]:
            change(message)
            return [message]

        return apply

    return make_it


def _shift_stamp(seconds: float) -> Callable[[Random], Change]:
    def apply(message: Any) -> None:
        stamp = nanoseconds(message.header.stamp) + int(1e9 * seconds)
        message.header.stamp = time_message(min(max(stamp, 0), (2**31 - 1) * 10**9))

    return _each(apply)


def _frozen(random: Random) -> Change:
    first: list[Any] = []

    def apply(message: Any) -> list[Any]:
        first.append(message)
        return [copy.deepcopy(first[0])]

    return apply


def _backwards(random: Random) -> Change:
    begin: list[int] = []

    def apply(message: Any) -> list[Any]:
        now = nanoseconds(message.header.stamp)
        begin.append(now)
        message.header.stamp = time_message(max(2 * begin[0] - now, 0))
        return [message]

    return apply


def _pose(message: Any) -> Any:
    return message.pose.pose if hasattr(message, "pose") else None


def _value(number: float) -> Callable[[Random], Change]:
    def apply(message: Any) -> None:
        pose = _pose(message)
        if pose is not None:
            pose.position.x = number
        if hasattr(message, "twist"):
            message.twist.twist.linear.x = number
        if hasattr(message, "angular_velocity"):
            message.angular_velocity.z = number

    return _each(apply)


def _orientation(message: Any) -> None:
    pose = _pose(message)
    if pose is not None:
        pose.orientation.w = pose.orientation.z = 0.0


def _frame(message: Any) -> None:
    message.header.frame_id = "elsewhere"
    if hasattr(message, "child_frame_id"):
        message.child_frame_id = "elsewhere"


def _flood(random: Random) -> Change:
    return lambda message: [copy.deepcopy(message) for _ in range(100)]


def _garbage(random: Random) -> Change:
    def apply(message: Any) -> list[Any]:
        content = bytearray(serialize_message(message))
        way = random.randrange(4)
        if way == 0:
            content = content[: random.randrange(len(content))]
        elif way == 1:
            content = bytearray(random.randbytes(random.choice((0, 1, 4, 5, 64, 1000))))
        elif way == 2:
            for _ in range(random.choice((1, 4, 20))):
                content[random.randrange(len(content))] = random.randrange(256)
        else:
            # Lengths of strings and sequences stand in front of them.
            place = 4 * random.randrange(1, max(2, len(content) // 4))
            content[place : place + 4] = random.choice((b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x10"))
        return [bytes(content)]

    return apply


def _noisy(random: Random) -> Change:
    def apply(message: Any) -> list[Any]:
        pose = _pose(message)
        if pose is not None:
            pose.position.x += random.gauss(0.0, 0.3)
            pose.position.y += random.gauss(0.0, 0.3)
        if hasattr(message, "twist"):
            message.twist.twist.linear.x = odd.near(message.twist.twist.linear.x, random)
        if hasattr(message, "angular_velocity"):
            message.angular_velocity.z = odd.near(message.angular_velocity.z, random)
        return [message]

    return apply


def _covariance(random: Random) -> Change:
    def apply(message: Any) -> list[Any]:
        for part in ("pose", "twist"):
            inner = getattr(message, part, None)
            if inner is not None and hasattr(inner, "covariance"):
                inner.covariance = [odd.number(random) for _ in range(36)]
        return [message]

    return apply


def _mixed_stamps(random: Random) -> Change:
    def apply(message: Any) -> list[Any]:
        shift = random.choice((0.0, 0.0, -0.02, -1.0, 0.1, 0.19, 0.21, 10.0, 1e6, -1e9, 1e9))
        stamp = nanoseconds(message.header.stamp) + int(1e9 * shift)
        message.header.stamp = time_message(min(max(stamp, 0), (2**31 - 1) * 10**9))
        return [message]

    return apply


_CHANGES: dict[str, Callable[[Random], Change]] = {
    "lost": lambda random: lambda message: [],
    "not a number": _value(math.nan),
    "infinite": _value(math.inf),
    "huge": _value(1e300),
    "other frame": _each(_frame),
    "no orientation": _each(_orientation),
    "an hour ago": _shift_stamp(-3600.0),
    "far ahead": _shift_stamp(1000.0),
    "a little ahead": _shift_stamp(0.15),
    "no stamp": _shift_stamp(-1e18),
    "latest stamp": _shift_stamp(1e10),
    "frozen": _frozen,
    "backwards": _backwards,
    "flood": _flood,
    "garbage": _garbage,
    "noisy": _noisy,
    "covariance": _covariance,
    "mixed stamps": _mixed_stamps,
}
CHANGES = tuple(_CHANGES)
# Without a good message for as long as they last.
BLINDING = (
    "lost",
    "not a number",
    "infinite",
    "other frame",
    "no orientation",
    "an hour ago",
    "far ahead",
    "no stamp",
    "latest stamp",
    "backwards",
)
