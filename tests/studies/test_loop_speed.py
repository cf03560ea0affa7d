"""The study of how fast the closed loop is simulated: its parts are those of the loop, and it writes what it found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc.sim import simulate
from studies.loop_speed import study


def test_the_plant_alone_drives_what_it_drove_in_the_loop():
    """Or another motion would be timed than that of the loop."""
    controller, plant, reference = build(Case(model="ssm", trajectory="cane"))
    run = simulate(controller, plant, reference)
    in_loop = plant.true_pose
    study._drive(plant, run)
    np.testing.assert_array_equal(plant.true_pose, in_loop)


def test_it_writes_every_drive_with_its_parts(tmp_path, capsys):
    plan = study.LoopSpeedStudy(("ssm", "sm"), ("cane",), "model:sm", "pose_jump", 2)
    carry_out(plan, tmp_path / "out")
    runs = json.loads((tmp_path / "out" / "loop-speed.json").read_text())["runs"]
    assert [(row["model"], row["trajectory"], row["scenario"]) for row in runs] == [
        ("ssm", "cane", "pose_jump"),
        ("sm", "cane", "pose_jump"),
    ]
    for row in runs:
        assert row["driven"] == pytest.approx(row["ticks"] * 0.0202)
        assert min(row[part] for part in ("loop", "metrics", "controller", "plant")) > 0
    assert "Times real time" in capsys.readouterr().out
