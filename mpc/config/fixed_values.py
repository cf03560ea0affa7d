"""Constants that are the same for all robots.

`fixed_values.yaml` contains former keys of the configuration; this module contains thresholds of re-entry for Python
and the core. Thresholds of the sensor test are in `sensor_test.yaml`, those of single measurements in
`core_thresholds.yaml`.
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
"""Speed below which a reference is at standstill [m/s]; its direction is then that of the next motion."""
TURNING = 0.05
"""Yaw rate above which a reference at standstill turns on the spot [rad/s]."""
BEHIND = 3.0
"""Distance behind the reference, over `reentry.wait`, beyond which a robot was moved [-]; waiting explains 2."""
AHEAD = 1.5
"""Distance ahead of the reference, over `reentry.wait`, beyond which a robot was moved [-]."""
