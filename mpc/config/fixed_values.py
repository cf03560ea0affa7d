"""Constants that are the same for all robots.

`fixed_values.yaml` contains constants that were configuration keys. `sensor_test.yaml` contains thresholds of the
sensor test, and `core_thresholds.yaml` thresholds for the validity of single measurements. This module defines
thresholds of re-entry that Python and the core share.
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
"""Speed below which a reference is at standstill [m/s]; its direction of travel is then that of the next motion."""
TURNING = 0.05
"""Yaw rate above which a reference at standstill turns on the spot [rad/s]."""
BEHIND = 3.0
"""Ratio of the distance behind the reference to `reentry.wait` above which the robot counts as displaced [-].

A ratio up to 2 is normal, since the reference waits for a lagging robot.
"""
AHEAD = 1.5
"""Ratio of the distance ahead of the reference to `reentry.wait` above which the robot counts as displaced [-]."""
