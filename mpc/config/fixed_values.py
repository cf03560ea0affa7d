"""Constants that are the same for all robots.

`fixed_values.yaml` contains constants that were configuration keys. This module defines thresholds of re-entry for
Python and the core. `sensor_test.yaml` contains thresholds of the sensor test, and `core_thresholds.yaml` contains
thresholds of single measurements.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import read_yaml

FILE = "mpc/config/fixed_values.yaml"


@cache
def fixed_values() -> Mapping[str, float]:
    """Return all constants by dotted key."""
    groups = read_yaml(Path(__file__).with_name("fixed_values.yaml"))
    return {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}


STANDING = 0.02
"""Speed below which a reference is at standstill [m/s]; its direction of travel is then that of its next motion."""
TURNING = 0.05
"""Yaw rate above which a reference at standstill turns on the spot [rad/s]."""
BEHIND = 3.0
"""Distance behind the reference, divided by `reentry.wait`, beyond which the robot was displaced [-].

A lag of twice `reentry.wait` is normal, since the reference then waits.
"""
AHEAD = 1.5
"""Distance ahead of the reference, divided by `reentry.wait`, beyond which the robot was displaced [-]."""
