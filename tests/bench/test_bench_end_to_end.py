"""The commands as a user runs them, on the physics."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from bench.cli import app
from sim.log_csv import read_log

runner = CliRunner()


def test_a_quick_bench_writes_its_report(tmp_path: Path) -> None:
    arguments = "--quick --models ssm --trajectories cane --jobs 1 --controller mpc,kanayama"
    result = runner.invoke(app, ["bench", "--out", str(tmp_path / "out"), *arguments.split()])
    assert result.exit_code == 0, result.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["bench.json", "bench.md", "figures"]
    ours, peer = json.loads((tmp_path / "out" / "bench.json").read_text())["runs"]
    assert (ours["controller"], ours["plant"], peer["controller"]) == ("mpc", "mujoco", "kanayama")
    assert ours["completed"] and peer["completed"]
    assert ours["in_band_percent"] == 100.0
    assert ours["fallbacks"] == 0
    assert "Summary" in result.stdout


def test_a_sweep_compares_the_values_of_a_field(tmp_path: Path) -> None:
    arguments = "--models ssm --trajectories cane --seeds 1 --jobs 1 --plant model:ssm --set horizon=8,25"
    result = runner.invoke(app, ["bench", "--out", str(tmp_path), *arguments.split()])
    assert result.exit_code == 0, result.stderr
    runs = json.loads((tmp_path / "bench.json").read_text())["runs"]
    assert [run["horizon"] for run in runs] == [8, 25]
    assert [run["set"] for run in runs] == [{"horizon": 8}, {"horizon": 25}]
    assert runs[0]["position_rmse_m"] != runs[1]["position_rmse_m"]


def test_simulate_draws_and_logs_the_same_run_every_time(tmp_path: Path) -> None:
    logs = []
    for name in ("first", "second"):
        arguments = ["--trajectory", "cane", "--seed", "3", "--log", str(tmp_path / f"{name}.csv")]
        result = runner.invoke(app, ["simulate", *arguments, "--out", str(tmp_path / name)])
        assert result.exit_code == 0, result.stderr
        assert sorted(path.name for path in (tmp_path / name).iterdir()) == ["ssm-cane-step-time.png", "ssm-cane.png"]
        logs.append(read_log(tmp_path / f"{name}.csv"))
    for column, values in logs[0].items():
        assert np.array_equal(values, logs[1][column], equal_nan=True), column
    assert np.isfinite(logs[0]["wheel_fl_rad_s"][5:]).all()


def test_scenarios_are_compared_and_replayed(tmp_path: Path) -> None:
    arguments = "--quick --models ssm --trajectories cane --jobs 1 --scenario none,push"
    result = runner.invoke(app, ["bench", "--out", str(tmp_path), *arguments.split()])
    assert result.exit_code == 0, result.stderr
    report = json.loads((tmp_path / "bench.json").read_text())
    plain, pushed = report["runs"]
    assert report["meta"]["experiment"]["scenarios"] == ["none", "push"]
    assert (plain["scenario"], pushed["scenario"]) == ("none", "push")
    assert plain["recovery_time_s"] is None
    assert plain["disturbance_s"] is None
    assert 4.0 <= pushed["disturbance_s"][0] < pushed["disturbance_s"][1] <= 5.25
    assert pushed["lateral_max_m"] > 0.05 > plain["lateral_max_m"]
    assert 0.0 < pushed["recovery_time_s"] < 3.0
    assert pushed["overshoot_m"] >= 0.0
    assert pushed["command_energy_v"] > 0.0 < pushed["command_energy_omega"]
    text = (tmp_path / "bench.md").read_text()
    assert "## Scenarios" in text
    assert "| none | SSM | - | - | - |" in text
    assert "scenarios none, push, seeds 0" in text


def test_simulate_shows_the_recovery_from_a_scenario() -> None:
    arguments = ["--trajectory", "cane", "--plant", "model:ssm"]
    plain, offset = (
        runner.invoke(app, ["simulate", *arguments, "--scenario", scenario]) for scenario in ("none", "start_offset")
    )
    assert plain.exit_code == offset.exit_code == 0, offset.stderr
    assert "recovery" not in plain.stdout
    assert "recovery" in offset.stdout
    # Turned away from its path by 20 degrees, it gets a little further off before the smooth way back turns it in.
    largest = float(re.findall(r"start_offset.*", offset.stdout)[-1].split()[5])
    assert 0.2 <= largest < 0.3
