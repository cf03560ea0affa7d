"""Paths that are timed by a speed passport, and what a passport refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.trust import UntrustedFileError, only_trusted
from diffdrive_mpc.mpc.trajectories import load_trajectory

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
WAYPOINTS = "waypoints: [[0, 0], [1.5, 0.2], [3, 1], [3.2, 2.5], [2, 3.5], [0, 3.7]]\n"
SEGMENTS = "segments:\n- {v: 1.2, omega: 0, duration: 3}\n- {v: 1.0, omega: 0.8, duration: 2}\n"


def write(folder: Path, drawn: str, use: dict[str, object], timing: str = "smooth") -> Path:
    (folder / "passport.yaml").write_text(yaml.safe_dump(PASSPORT), encoding="utf-8")
    path = folder / "path.yaml"
    key = yaml.safe_dump({"speed_passport": {"file": "passport.yaml", **use}})
    path.write_text(f"timing: {timing}\n{drawn}{key}", encoding="utf-8")
    return path


def allowed(curvature: float, row: int) -> float:
    """Greatest speed [m/s] for a curvature [1/m], taken from the table by hand."""
    speeds, curvatures = PASSPORT["rows"][row]["speeds"], PASSPORT["curvatures"]
    index = next(k for k, end in enumerate(curvatures) if curvature <= end + 1e-6)
    return float(min(speeds[: index + 1]))


@pytest.mark.parametrize("drawn", [WAYPOINTS, SEGMENTS])
@pytest.mark.parametrize(("use", "rows"), [({"surface": "firm"}, [1]), ({}, [1, 2])])
def test_no_place_is_faster_than_the_passport_allows(
    drawn: str, use: dict[str, object], rows: list[int], tmp_path: Path
) -> None:
    path = write(tmp_path, drawn, {"tolerance": 0.03, **use})
    timed = load_trajectory(path)
    v, omega = timed.sample(np.linspace(0.0, timed.duration, 3000)).twist.T
    moving = v > 0.05
    shares = [
        speed / min(allowed(bend, row) for row in rows)
        for speed, bend in zip(v[moving], np.abs(omega[moving] / v[moving]), strict=True)
    ]
    # The cubics between the nodes of the path go a little beyond.
    assert 0.95 < max(shares) < 1.02


@pytest.mark.parametrize(
    ("use", "timing", "line"),
    [
        ({"tolerance": 0.005}, "smooth", "the least tolerance of the passport is 0.01 m"),
        ({"tolerance": 0.02, "surface": "ice"}, "smooth", "unknown surface 'ice'; known: firm, wet"),
        ({"tolerance": 0.02}, "stop", "timing 'stop' takes none"),
        ({"tolerance": 0.01, "surface": "firm"}, "smooth", "no speed is proven for a curvature of 1.25 1/m"),
        ({"tolerance": 0.02, "file": "none.yaml"}, "smooth", "none.yaml"),
    ],
)
def test_what_it_does_not_know_is_one_line(use: dict[str, object], timing: str, line: str, tmp_path: Path) -> None:
    drawn = "segments:\n- {v: 1.0, omega: 1.25, duration: 2}\n"
    with pytest.raises(ConfigError, match=line):
        load_trajectory(write(tmp_path, drawn, use, timing))


def test_a_tighter_turn_than_it_knows_is_refused(tmp_path: Path) -> None:
    drawn = "segments:\n- {v: 0.4, omega: 1.0, duration: 2}\n"
    with pytest.raises(ConfigError, match=r"curvature of 2\.5 1/m, the passport knows none above 2 1/m"):
        load_trajectory(write(tmp_path, drawn, {"tolerance": 0.02}))


@pytest.mark.parametrize("segment", ["{v: -0.4, omega: 0.1, duration: 2}", "{v: 0.0, omega: 0.5, duration: 2}"])
def test_what_was_never_measured_is_refused(segment: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="covers no backward driving and no turn on the spot"):
        load_trajectory(write(tmp_path, f"segments:\n- {segment}\n", {"tolerance": 0.02}))


def test_two_rows_for_one_tolerance_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, SEGMENTS, {"tolerance": 0.02})
    twice = {**PASSPORT, "rows": [*PASSPORT["rows"], PASSPORT["rows"][0]]}
    (tmp_path / "passport.yaml").write_text(yaml.safe_dump(twice), encoding="utf-8")
    with pytest.raises(ConfigError, match="two rows have the same surface and tolerance"):
        load_trajectory(path)


def test_a_passport_that_is_not_trusted_is_not_opened(tmp_path: Path) -> None:
    path = write(tmp_path, SEGMENTS, {"tolerance": 0.02, "file": "../passport.yaml"})
    inside = path.rename(tmp_path / "in.yaml")
    with only_trusted("a run", [tmp_path]), pytest.raises(UntrustedFileError, match="passport"):
        load_trajectory(inside)
