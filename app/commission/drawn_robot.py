"""A robot of the physics that nobody knows, drawn from a seed."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffdrive_mpc.bench.campaign.draws import Draw, read_factor
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.whole_file import whole_file

_FILE = Path(__file__).with_name("drawn_robots.yaml")
_SKID = "skid_share"


def drawn_robot(seed: int) -> dict[str, Any]:
    """A robot file as plain data; one of a seed is always the same."""
    draws = _draws()
    points = np.random.default_rng(seed).uniform(size=len(draws))
    drawn = {
        name: float(f"{draw.value(point, 0):.4g}") for (name, draw), point in zip(draws.items(), points, strict=True)
    }
    drawn["firmware.track"] = float(f"{drawn.pop(_SKID) * drawn['robot.track']:.4g}")
    content: dict[str, Any] = {"description": f"drawn robot, seed {seed}"}
    for name, value in drawn.items():
        *groups, key = name.split(".")
        place = content
        for group in groups:
            place = place.setdefault(group, {})
        place[key] = value
    return content


def write_drawn_robot(seed: int, path: Path) -> None:
    """Write the robot file; raises ConfigError if it cannot be written."""
    with whole_file(path) as draft:
        draft.write_text(yaml.safe_dump(drawn_robot(seed), sort_keys=False), encoding="utf-8")


@cache
def _draws() -> dict[str, Draw]:
    data = read_yaml(_FILE)
    read = {str(name): read_factor(draw, f"{_FILE.name}: {name}") for name, draw in dict(data).items()}
    return {name: draw for name, draw in read.items() if isinstance(draw, Draw)}
