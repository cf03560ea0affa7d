"""Constants that are the same for all robots.

`fixed_values.yaml` holds former keys of the configuration; thresholds of re-entry, for Python and the core, are here.
Thresholds of the sensor test are in `sensor_test.yaml`, those of single measurements in `core_thresholds.yaml`.
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
"""A reference below this speed counts as standing [m/s]: its heading is then that of the next motion."""
TURNING = 0.05
"""... A standing reference above this yaw rate turns on the spot [rad/s]."""
BEHIND = 3.0
"""In units of `reentry.wait`: waiting leaves a robot behind by twice that at most; further back it was moved [-]."""
AHEAD = 1.5
"""The same for a robot that is ahead of its reference, which it never is by much unless it was moved [-]."""
