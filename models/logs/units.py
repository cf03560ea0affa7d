"""Units that a log may use, as factors to SI."""

from __future__ import annotations

import math
from typing import Literal

TimeUnit = Literal["s", "ms", "us", "ns"]
LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
SpeedUnit = Literal["m/s", "cm/s", "mm/s", "km/h"]
RateUnit = Literal["rad/s", "deg/s", "rpm"]
WheelUnit = Literal["rad/s", "deg/s", "rpm", "ticks/s", "ticks", "m/s"]

FACTORS: dict[str, float] = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "m/s": 1.0,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
    "km/h": 1.0 / 3.6,
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "rpm": 2.0 * math.pi / 60.0,
}
"""SI value of one of each unit. A wheel's ticks and rim speeds also need its ticks per turn or its radius."""

MIXED_UP: dict[str, float] = {
    "degrees and radians": 180.0 / math.pi,
    "revolutions per minute and rad/s": 60.0 / (2.0 * math.pi),
    "revolutions and radians": 2.0 * math.pi,
    "millimetres and metres": 1000.0,
    "centimetres and metres": 100.0,
    "km/h and m/s": 3.6,
}
"""Factors by which a signal is wrong when two units were mixed up, either way round."""
