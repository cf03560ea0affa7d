"""Constants of `fixed_values.yaml`: former keys of the configuration that no robot has to change."""

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
