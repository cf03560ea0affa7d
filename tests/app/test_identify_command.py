"""From a simulated log to a folder that configures the controller, through the command line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from opened_report import check_report

from commands import invoke
from diffdrive_mpc import load_config
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.mpc.trajectories.load import load_segments
from diffdrive_mpc.sim.plants.surface import load_surface

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
REPORT_KEYS = ["model", "train_fit_percent", "validation_fit_percent", "pose_error", "parameters", "warnings"]


def run(*arguments):
    return invoke(app, *arguments).stdout


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Three closed-loop drives of a plant whose velocity model is the shipped SM, with the default sensors."""
    folder = tmp_path_factory.mktemp("logs")
    for trajectory in ("square", "s", "cane"):
        command = f"simulate --model sm --plant model:sm --trajectory {trajectory} --log {folder / trajectory}.csv"
        run(*command.split())
    return folder


@pytest.fixture(scope="module")
def identified_robot(logs):
    """Folder and output of an identification from two of the drives, validated on the third."""
    arguments = ["identify", logs / "square.csv", logs / "s.csv", "--validate", logs / "cane.csv", "--name", "mine"]
    return logs / "mine", run(*arguments, "--out", logs / "mine")


def test_report_has_the_agreed_keys(identified_robot):
    report = json.loads((identified_robot[0] / "report.json").read_text())
    assert list(report) == [*REPORT_KEYS, "verdict"]
    assert report["model"] == "sm"
    assert all(set(report[f"{part}_fit_percent"]) == {"v", "omega"} for part in ("train", "validation"))
    assert min(report["validation_fit_percent"].values()) > 85.0
    assert [entry["horizon_s"] for entry in report["pose_error"]] == [1.0, 2.0, 5.0]
    assert all(set(e) == {"horizon_s", "position_rmse_m", "heading_rmse_rad"} for e in report["pose_error"])
    assert all(set(entry) == {"value", "standard_deviation"} for entry in report["parameters"].values())
    assert {"v.gain", "omega.dead_time", "poses.track", "poses.gyro_scale"} <= set(report["parameters"])
    assert any("10 s" in warning for warning in report["warnings"])  # no stretch between two poses lasts 10 s


def test_report_ends_with_the_first_drive_on_the_robot(identified_robot, monkeypatch):
    """The command of the first drive runs slowly in the folder, and all linked files exist."""
    out, _ = identified_robot
    _, _, recipe = (out / "report.md").read_text().partition("## The first drive on the robot")
    (command,) = re.findall(r"`diffdrive-mpc (simulate .*?)`", recipe)
    monkeypatch.chdir(out)
    assert run(*command.split()).startswith("completed: ")
    (turn,) = load_segments("first_circle.yaml")
    assert 0.0 < turn.v < 0.4 * load_config("config.yaml").limits.v
    assert turn.omega * turn.duration == pytest.approx(2 * np.pi, rel=1e-4)
    pages = set(re.findall(r"docs/\w+\.md", recipe))
    assert pages == {"docs/robot.md", "docs/safety.md"}
    assert all((ROOT / page).is_file() for page in pages)


@pytest.mark.system("browser")
def test_report_page_is_drawn_in_a_browser(identified_robot):
    check_report(identified_robot[0] / "report.html")


def test_configuration_drives_the_plant(identified_robot, logs):
    """The configuration passes `config check`, and tracks as well as the configuration shipped for the plant."""
    config = identified_robot[0] / "config.yaml"
    assert "valid" in run("config", "check", config)
    loaded = load_config(config)
    assert loaded.sample_time == 0.0202
    assert loaded.wheels.encoder_track == pytest.approx(0.330, rel=1e-3)
    # The square turns on the spot at 1.0 rad/s and drives at 0.5 m/s; corrections slightly exceed these values.
    assert 0.5 <= loaded.limits.v < 0.7
    assert 1.0 <= loaded.limits.omega < 1.5
    start, truth = loaded.estimator, load_surface("default").slip.side_slip
    assert abs(start.side_slip - truth) < 2 * start.side_slip_uncertainty < 0.08
    bench = logs / "bench"
    command = f"bench --out {bench} --plant model:sm --trajectories s --seeds 1 --horizons none --jobs 1 --models"
    run(*command.split(), f"sm,{identified_robot[0] / 'model.yaml'}")
    shipped, identified_run = json.loads((bench / "bench.json").read_text())["runs"]
    assert identified_run["completed"]
    assert identified_run["position_rmse_m"] < 1.2 * shipped["position_rmse_m"]
