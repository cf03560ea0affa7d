"""Small plans for tests of the tuning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
PLAN = """
description: short drives of a model
points: 6
parameters:
  weights.across: {times: [0.2, 5.0]}
  horizon: {low: 15, high: 40}                      # steps
runs: {plant: "model:sm", trajectory: short.yaml}
tuning_seeds: {first: 600, count: 1}
report_seeds: {first: 700, count: 4}
"""


def write_plan(folder: Path, changes: Mapping[str, object] | None = None) -> Path:
    """Write the plan with changed top-level values, and its path file next to it."""
    (folder / "short.yaml").write_text(SHORT, encoding="utf-8")
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(PLAN) | dict(changes or {})), encoding="utf-8")
    return path
