"""Parameters for other packages: exact without noise, and a reason where a log does not tell them."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from stack_parts import drawn_log, load_population
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.identification.stack import estimate_stack, look_ahead_factor
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.stack import package_text, packages

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


def test_unknown_package_is_one_line_with_the_known_ones(tmp_path):
    result = CliRunner().invoke(app, ["identify", "no.csv", "--for", "nav2,moveit", "--out", str(tmp_path / "x")])
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "'moveit': no installed package has it; installed: nav2, robot_localization, ros2_control" in result.stderr


@pytest.mark.long
def test_intervals_hold_the_truth_of_drawn_robots():
    """Robots with reserved seeds; errors within the tolerances, and 95 % inside the interval of the share."""
    tolerances, inside, within = load_population().tolerances, [], []
    for seed in range(1000, 1040, 2):
        log = drawn_log(seed)
        quantities = estimate_stack(log.data)
        for name, truth in log.truth.items():
            quantity = quantities[name]
            if quantity.value is None:
                continue
            assert log.reached.get(name, True), f"{name} is stated but was not reached"
            error = abs(quantity.value - truth) / (1.0 if name.startswith("delay") else truth)
            within.append(error <= tolerances[name.partition(".")[0]])
            inside.append(quantity.interval[0] <= truth <= quantity.interval[1])
    assert Rate.of_runs(sum(inside), len(inside)).high >= 0.95
    assert np.mean(within) >= 0.95
