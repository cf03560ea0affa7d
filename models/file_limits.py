"""Maximum sizes of input files and their parts, so that no file exhausts the memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import yaml


@dataclass(frozen=True)
class FileLimits:
    """Limits by name; `file_limits.yaml` states the unit and the reason of each limit."""

    yaml_bytes: int
    yaml_depth: int
    yaml_values: int
    states: int
    window: int
    units: int
    layers: int
    multiplications: int
    weights_spare: int
    bag_chunk: int
    bag_files: int
    bag_topics: int
    bag_ratio: int
    bag_always: int
    sqlite_steps: int
    drive_ticks: int
    drive_ticks_always: int
    json_bytes: int
    csv_words: int


@cache
def file_limits() -> FileLimits:
    """Load the shipped limits; `checked_yaml` is not used here because it needs them."""
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    return FileLimits(**yaml.safe_load(text))
