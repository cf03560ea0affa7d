"""What costmaps and obstacles may say, by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any

from fuzz import odd
from fuzz.live import references
from fuzz.live.base import disc_cloud

WAYS = (
    "lost",
    "closed",
    "everywhere",
    "drawn",
    "other frame",
    "other size",
    "not a number",
    "no resolution",
    "ahead",
    "old",
    "garbage",
    "",
)


def around(how: str, random: Random, pose: list[float]) -> Callable[[Any], list[Any]]:
    """The change `how` of either message; what it draws comes from `random`."""

    def apply(message: Any) -> list[Any]:
        if how == "lost":
            return []
        if how == "garbage":
            return [references.spoilt(message, random)]
        if how in ("other frame", "ahead", "old"):
            message.header.frame_id = "elsewhere" if how == "other frame" else message.header.frame_id
            shift = {"ahead": 1000, "old": -1000}.get(how, 0)
            message.header.stamp.sec = min(max(message.header.stamp.sec + shift, 0), 2**31 - 1)
            return [message]
        return [_grid(how, random, message) if hasattr(message, "info") else _discs(how, random, pose, message)]

    return apply


def _grid(how: str, random: Random, message: Any) -> Any:
    if how == "closed":
        message.data = [100 if i % 40 > 28 else 0 for i in range(1600)]
    elif how == "everywhere":
        message.data = [100] * 1600
    elif how == "drawn":
        message.data = [random.choice((0, 0, 0, 0, 100, -1, 50, -128, 127)) for _ in range(1600)]
    elif how == "other size":
        message.info.width = random.choice((0, 1, 39, 2**32 - 1))
    elif how == "not a number":
        message.info.origin.position.x = random.choice((math.nan, math.inf, 1e300))
    elif how == "no resolution":
        message.info.resolution = random.choice((0.0, -1.0, math.nan, 1e-30, 1e30))
    return message


def _discs(how: str, random: Random, pose: list[float], honest: Any) -> Any:
    x, y, theta = pose
    ahead = [x + math.cos(theta), y + math.sin(theta), 0.3, 0.0, 0.0]
    discs = {
        "closed": [ahead],
        "everywhere": [[x, y, 0.5, 0.0, 0.0]],
        "drawn": [[x + random.gauss(0, 2), y + random.gauss(0, 2), 0.2, random.gauss(0, 1), 0.0] for _ in range(20)],
        "not a number": [[odd.number(random) for _ in range(5)]],
    }.get(how, [])
    message = disc_cloud(discs)
    message.header = honest.header
    if how == "other size":
        message.width = random.choice((1, 501, 2**32 - 1))
    elif how == "no resolution":
        message.point_step = random.choice((0, 1, 39, 2**32 - 1))
    return message
