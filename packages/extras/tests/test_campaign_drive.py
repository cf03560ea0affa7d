"""One run of a campaign: its commands are checked, also those that the loop refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.models.interface import ControlStep, Measurement
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.campaign import drive as drive_module
from diffdrive_mpc_extras.campaign.command_check import Unsafe
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drive import RecordedController, drive

NONE = Unsafe(0, 0, 0, 0)
BLACKOUT = """
description: poses stay away for good while the robot drives
drop_outs: [{sensor: pose, start: 2.0, duration: 60.0}]
"""


@pytest.mark.parametrize("scenario", ["sensor_dropouts", "push", "frozen_pose", "pose_jump"])
def test_the_controller_keeps_what_it_states(scenario: str) -> None:
    row = drive(Definition.of({"scenario": scenario, "model": "sm"}))
    assert row["error"] == ""
    assert [row[f"unsafe_{name}"] for name in ("not_finite", "limit", "slew", "motion")] == [0] * 4


def test_without_poses_it_stops_in_time_and_one_tick_later_would_be_found(tmp_path: Path) -> None:
    path = tmp_path / "blackout.yaml"
    path.write_text(BLACKOUT, encoding="utf-8")
    definition = Definition.of({"scenario": str(path), "plant": "model:ssm", "config.failure.dead_reckoning": 0.0})
    controller, plant, reference = build(definition.case)
    watched = RecordedController(controller)
    run = simulate(watched, plant, reference)
    assert run.modes[-1] == "STOPPED"
    assert watched.unsafe(definition) == NONE
    # What is sent half a second late is motion that was not allowed.
    late = int(0.5 / run.sample_time)
    watched.commands = [*[watched.commands[0]] * late, *watched.commands[:-late]]
    found = watched.unsafe(definition)
    assert found is not None
    assert found.motion >= late - 2


def test_a_command_that_the_loop_refuses_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    step = RecordedController.step

    def poisoned(self: RecordedController, t: float, measurement: Measurement) -> ControlStep:
        result = step(self, t, measurement)
        if len(self.times) == 30:
            self.commands[-1] = (np.nan, 0.0)
            raise ValueError("the controller's command must be two finite numbers")
        return result

    monkeypatch.setattr(drive_module.RecordedController, "step", poisoned)
    row = drive(Definition.of({"plant": "model:ssm"}))
    assert row["unsafe_not_finite"] == 1
    assert row["completed"] is False
    assert "two finite numbers" in str(row["error"])
