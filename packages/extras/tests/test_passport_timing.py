"""Trajectories timed by a speed passport."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError, load_trajectory
from diffdrive_mpc.models.trust import UntrustedFileError, only_trusted

PASSPORT: dict[str, Any] = {
    "description": "made up",
    "share": 0.95,
    "confidence": 0.95,
    "curvatures": [0.0, 0.5, 1.0, 2.0],
    "rows": [
        {"surface": "firm", "tolerance": 0.01, "speeds": [0.8, 0.5, 0.6, None]},
        {"surface": "firm", "tolerance": 0.02, "speeds": [1.2, 0.9, 0.7, 0.4]},
        {"surface": "wet", "tolerance": 0.02, "speeds": [1.0, 0.6, 0.65, 0.2]},
    ],
}
WAYPOINTS = "max_deviation: 0.5\nwaypoints: [[0, 0], [1.5, 0.2], [3, 1], [3.2, 2.5], [2, 3.5], [0, 3.7]]\n"
SEGMENTS = "segments:\n- {v: 1.2, omega: 0, duration: 3}\n- {v: 1.0, omega: 0.8, duration: 2}\n"


def write(folder: Path, path_text: str, options: dict[str, object], timing: str = "smooth") -> Path:
    (folder / "passport.yaml").write_text(yaml.safe_dump(PASSPORT), encoding="utf-8")
    path = folder / "path.yaml"
    key = yaml.safe_dump({"speed_passport": {"file": "passport.yaml", **options}})
    path.write_text(f"timing: {timing}\n{path_text}{key}", encoding="utf-8")
    return path


def max_speed(curvature: float, row: int) -> float:
    """Return the maximum speed [m/s] for a curvature [1/m], from the table."""
    speeds, curvatures = PASSPORT["rows"][row]["speeds"], PASSPORT["curvatures"]
    index = next(k for k, end in enumerate(curvatures) if curvature <= end + 1e-6)
    return float(min(speeds[: index + 1]))


@pytest.mark.parametrize("path_text", [WAYPOINTS, SEGMENTS])
@pytest.mark.parametrize(("options", "rows"), [({"surface": "firm"}, [1]), ({}, [1, 2])])
def test_speed_stays_below_the_passport_everywhere(
    path_text: str, options: dict[str, object], rows: list[int], tmp_path: Path
) -> None:
    path = write(tmp_path, path_text, {"tolerance": 0.03, **options})
    trajectory = load_trajectory(path)
    v, omega = trajectory.sample(np.linspace(0.0, trajectory.duration, 3000)).twist.T
    is_moving = v > 0.05
    ratios = [
        speed / min(max_speed(bend, row) for row in rows)
        for speed, bend in zip(v[is_moving], np.abs(omega[is_moving] / v[is_moving]), strict=True)
    ]
    # The cubics between the nodes slightly exceed the passport.
    assert 0.95 < max(ratios) < 1.02


@pytest.mark.parametrize(
    ("options", "timing", "message"),
    [
        ({"tolerance": 0.02}, "stop", "not available with timing 'stop'"),
        ({"tolerance": 0.01, "surface": "firm"}, "smooth", "no speed is proven for a curvature of 1.25 1/m"),
    ],
)
def test_unknown_passport_entry_is_reported_in_one_line(
    options: dict[str, object], timing: str, message: str, tmp_path: Path
) -> None:
    path_text = "segments:\n- {v: 1.0, omega: 1.25, duration: 2}\n"
    with pytest.raises(ConfigError, match=message):
        load_trajectory(write(tmp_path, path_text, options, timing))


@pytest.mark.parametrize("segment", ["{v: -0.4, omega: 0.1, duration: 2}", "{v: 0.0, omega: 0.5, duration: 2}"])
def test_unmeasured_motion_raises_error(segment: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not cover backward driving and turns on the spot"):
        load_trajectory(write(tmp_path, f"segments:\n- {segment}\n", {"tolerance": 0.02}))


def test_untrusted_passport_is_not_opened(tmp_path: Path) -> None:
    path = write(tmp_path, SEGMENTS, {"tolerance": 0.02, "file": "../passport.yaml"})
    trusted_path = path.rename(tmp_path / "in.yaml")
    with only_trusted("a run", [tmp_path]), pytest.raises(UntrustedFileError, match="passport"):
        load_trajectory(trusted_path)
