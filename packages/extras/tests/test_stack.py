"""Parameters for other packages: exact without noise, and a reason where a log does not tell them."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from studies.stack.peers import LIMITS, PURSUIT, known, later, limited
from studies.stack.population import drawn_log
from studies.stack.study import StackStudy, coverage_table
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.identification.stack import Quantity, estimate_stack, look_ahead_factor
from diffdrive_mpc.mpc import Controller, load_config
from diffdrive_mpc_extras.stack.stack import chosen_packages, package_text, packages
from studies.cli import app as studies_app

CLEAN = 1e-3
SEED = 1


@pytest.fixture(scope="module")
def exact():
    """A log without noise in which both channels are clipped, and what it tells."""
    log = drawn_log(SEED, noise=CLEAN, seconds=60.0, limit=0.7)
    return log, estimate_stack(log.data)


def loaded(text):
    return yaml.safe_load(text)


def test_a_clean_log_tells_everything(exact):
    log, quantities = exact
    for name, truth in log.truth.items():
        tolerance = 0.003 if name.startswith("delay") else 0.01 * truth
        assert quantities[name].value == pytest.approx(truth, abs=tolerance), name


def test_files_have_the_packages_structure(exact):
    files = {package: loaded(package_text(package, exact[1])) for package in packages()}
    assert set(files["ros2_control"]) == {"/**", "imu_sensor_broadcaster"}
    for content in files.values():
        assert all(set(node) == {"ros__parameters"} for node in content.values())
    control = files["ros2_control"]["/**"]["ros__parameters"]
    assert len(control["twist_covariance_diagonal"]) == 6
    assert control["linear.x.max_deceleration"] == -control["linear.x.max_acceleration"]
    smoother = files["nav2"]["velocity_smoother"]["ros__parameters"]
    assert [value > 0 for value in smoother["max_velocity"]] == [True, False, True]
    assert smoother["max_velocity"][0] == control["linear.x.max_velocity"]
    assert len(files["robot_localization"]["/**"]["ros__parameters"]["odom0_config"]) == 15
    numbers = [value for value in control.values() if not isinstance(value, list)]
    assert all(isinstance(value, float) for value in numbers)


def test_without_wheel_speeds_multipliers_are_a_note():
    quantities = estimate_stack(drawn_log(SEED, noise=CLEAN, seconds=60.0, wheels=False).data)
    for name in ("left_radius_multiplier", "wheel_radius", "separation_multiplier"):
        assert quantities[name].value is None
    text = package_text("ros2_control", quantities)
    assert "# wheel_separation_multiplier: not known: " in text
    assert "multiply the one" in text
    assert "wheel_radius" not in loaded(text)["/**"]["ros__parameters"]


def test_without_a_pose_the_gyro_tells_the_multiplier():
    """It scales as the yaw gain of the wheels does: of a body that turns less for the same wheels it is larger."""
    log = drawn_log(SEED, noise=CLEAN, seconds=60.0, pose=False)
    quantities = estimate_stack(log.data)
    assert quantities["left_radius_multiplier"].value is None
    assert "pose" in quantities["left_radius_multiplier"].reason
    multiplier = quantities["separation_multiplier"].value
    assert multiplier == pytest.approx(log.truth["separation_multiplier"], rel=0.02)
    spun = [replace(record, yaw_rate=0.8 * record.yaw_rate) for record in log.data.train]
    slower = estimate_stack(replace(log.data, train=tuple(spun)))
    assert slower["separation_multiplier"].value == pytest.approx(multiplier / 0.8, rel=0.01)


def test_without_gyro_and_pose_nothing_tells_the_multiplier():
    quantities = estimate_stack(drawn_log(SEED, noise=CLEAN, seconds=60.0, gyro=False, pose=False).data)
    assert quantities["separation_multiplier"].value is None
    assert quantities["variance.gyro"].value is None
    assert quantities["delay.v"].value is not None


def test_without_finite_intervals_there_is_no_value(monkeypatch):
    """A singular covariance: a note in place of each estimate, and of what follows from it."""
    unknown = "diffdrive_mpc.models.identification.stack.covariance"
    monkeypatch.setattr(unknown, lambda fit, _: np.full((len(fit.free), len(fit.free)), math.nan))
    quantities = estimate_stack(drawn_log(SEED, noise=CLEAN, seconds=30.0, limit=0.7, pose=False).data)
    for name in ("delay.v", "delay.omega", "separation_multiplier", "max.v", "rate.omega", "look_ahead_time"):
        assert quantities[name].value is None, name
    assert all("not finite" in quantities[name].reason for name in ("max.v", "look_ahead"))
    texts = [package_text(package, quantities) for package in packages()]
    assert not any(re.search(r"\b(nan|inf)\b", text) for text in texts)
    content = loaded(texts[list(packages()).index("nav2")])["controller_server"]["ros__parameters"]
    assert "FollowPath.lookahead_time" not in content


def test_the_controllers_frequency_is_that_of_the_settings(exact):
    content = loaded(package_text("nav2", exact[1]))["controller_server"]["ros__parameters"]
    assert content["controller_frequency"] == identification_settings().stack.controller_frequency


def test_the_least_look_ahead_is_that_of_the_slowest_speed(exact):
    slow, quantities = identification_settings().stack.slow_speed, exact[1]
    assert slow < quantities["driven.v"].value
    assert quantities["min_look_ahead"].value == pytest.approx(slow * quantities["look_ahead_time"].value)


def test_limits_that_are_not_reached_are_a_note():
    quantities = estimate_stack(drawn_log(SEED, seconds=60.0, limit=1.5).data)
    assert quantities["max.v"].value is None
    content = loaded(package_text("nav2", quantities))["velocity_smoother"]["ros__parameters"] or {}
    assert "max_velocity" not in content
    assert "# max_velocity: not known: max.v: not reached in this log" in package_text("nav2", quantities)


def test_look_ahead_keeps_the_phase_margin():
    """The phase of 2 (p + 1) exp(-theta p) / p^2 where its gain is one."""
    margin = math.radians(45.0)
    theta = 1.0 / look_ahead_factor(margin)
    crossing = math.sqrt(2.0 + math.sqrt(8.0))
    assert abs(2 * (1 + 1j * crossing) / crossing**2) == pytest.approx(1.0)
    assert math.atan(crossing) - theta * crossing == pytest.approx(margin)


def test_an_unknown_package_is_one_line_with_the_remedy(tmp_path):
    with pytest.raises(ConfigError, match=r"--for nav: unknown package; give one or more of ros2_control,nav2"):
        chosen_packages("nav")
    result = CliRunner().invoke(app, ["identify", "no.csv", "--for", "nav2,moveit", "--out", str(tmp_path / "x")])
    assert result.exit_code != 0
    assert "--for moveit: unknown package" in str(result.output) + str(result.exception)


def test_the_study_counts_what_is_estimated(tmp_path, monkeypatch):
    """Two robots: one table row for each quantity, and rows with truth and interval in the file."""
    rows = [
        {"seed": seed, "quantity": "max.v", "truth": 1.0, "value": value, "low": value - 0.02, "high": value + 0.02}
        | {"reached": reached, "seconds": 1.0}
        for seed, value, reached in ((0, 1.01, True), (2, 1.1, True), (4, math.nan, True), (6, 1.0, False))
    ]
    (row,) = coverage_table(rows).rows
    assert row[1:3] == ("2 of 3", "1 of 1")
    assert row[4].startswith("50.0 [")
    monkeypatch.setattr("studies.stack.study.estimated", lambda seed: rows[:1])
    carry_out(StackStudy(1, tuning=True), tmp_path / "out", 1)
    assert json.loads((tmp_path / "out" / "stack.json").read_text())["rows"][0]["quantity"] == "max.v"


def test_peers_take_the_parameters_that_nav2_gets():
    """Names of the study are those of the template; what a log does not tell keeps its default."""
    template = packages()["nav2"]["controller_server"]
    assert {name: template[f"FollowPath.{name}"] for name in PURSUIT} == PURSUIT
    quantities = told({"delay.v": 0.3, "delay.omega": 0.25, "look_ahead_time": 1.2, "max.v": 0.7})
    assert limited(quantities).limits.v == 0.7
    assert limited(quantities).limits.omega == load_config("sm").limits.omega
    assert later(quantities) == pytest.approx([0.3, 0.25] - Controller(load_config("sm")).model.lag)
    assert known(PURSUIT, quantities) == {"lookahead_time": 1.2}


def told(values):
    """Quantities of which the log tells only some."""
    names = {*PURSUIT.values(), *LIMITS.values(), "delay.v", "delay.omega"}
    return {name: Quantity(values.get(name), (math.nan, math.nan), "", "") for name in names}


def test_peers_drive_with_what_a_log_tells(tmp_path):
    """Of a robot that is 120 ms later than its model, `mppi` is better off with the delay that the log tells."""
    file = tmp_path / "drives.yaml"
    file.write_text(
        "{robots: ['mujoco:dead_time_160'], trajectories: [cane], seeds: [1, 3], log: {seconds: 25.0, seed: 5}}\n",
        encoding="utf-8",
    )
    words = ["stack", "--only", "peers", "--drives", str(file), "--jobs", "1", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(studies_app, words)
    assert result.exit_code == 0, f"{result.output}\n{result.exception!r}"
    content = json.loads((tmp_path / "out" / "stack.json").read_text())
    assert content["rows"] == []
    errors = {(row["peer"], row["variant"], row["seed"]): row["error_m"] for row in content["drives"]}
    assert len(errors) == 8
    assert all(errors["mppi", "identified", seed] < 0.5 * errors["mppi", "default", seed] for seed in (1, 3))
    table = (tmp_path / "out" / "stack.md").read_text()
    assert "| mujoco:dead_time_160 | mppi | all |" in table
    assert "| mujoco:dead_time_160 | mppi: model_delay.v | " in table
