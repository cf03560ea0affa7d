"""Parameters for other packages: values from clean logs, intervals, files, and reasons for missing values."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy import signal

from commands import refusal
from diffdrive_mpc.models.identification.log_data import LogData, divide
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.sim.plants.drawn_robot import draw_robot
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.stack.estimate import estimate_stack, look_ahead_factor
from diffdrive_mpc_extras.stack.parameter_files import package_text, packages

_FINE = 1e-3
"""Step of the simulation [s]."""


POPULATION = SimpleNamespace(**yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text()))
"""Ranges of the drawn parameters that the population of robots does not define; units in the file."""


@dataclass(frozen=True)
class DrawnLog:
    """Log of a random robot, with the true quantities by the names of `estimate_stack`."""

    data: LogData
    truth: Mapping[str, float]
    reached: Mapping[str, bool]


def drawn_log(
    seed: int,
    *,
    noise: float = 1.0,
    seconds: float | None = None,
    limit: float | None = None,
    has_pose: bool = True,
    damping: float | None = None,
) -> DrawnLog:
    """Simulate a log of the robot of a seed.

    Parameters
    ----------
    seed
        Seed of the robot and of its noise; even seeds are reserved for tests.
    noise
        Factor on noise, disturbance and bias [-].
    seconds, limit
        Duration of the log [s] and clipping level over the maximum command [-]; by default from the settings.
    has_pose
        True if the log has poses.
    damping
        Damping ratio of an overshooting robot with the same delay [-].
    """
    settings, build = POPULATION, draw_robot(seed).build
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(37,)))
    values = {name: float(stream.uniform(*getattr(settings, name))) for name in _DRAWN_PARAMETERS}
    dt, track, radius = settings.sample_time, build.robot.track, build.robot.wheel_radius
    stride = round(dt / _FINE)
    count = round((seconds or settings.seconds) / dt)
    max_command = np.array([values["speed"], values["turning"]])
    hold = round(values["hold"] / dt)
    command = max_command * np.repeat(stream.uniform(-1, 1, (count // hold + 1, 2)), hold, axis=0)[:count]
    effective_track = track * (1.0 if build.twin.chassis.castors else values["widening"])
    gain = np.array([1.0, build.firmware.track / effective_track])
    level, slew = (limit or values["limit"]) * max_command, max_command / values["slew_time"]
    lags = np.array([[build.firmware.lag_v, values["second_lag"]], [build.firmware.lag_omega, values["second_lag"]]])
    twist = _motor_response(
        np.repeat(np.clip(command, -level, level), stride, axis=0), slew, lags, build.twin.link.dead_time, damping
    )
    twist = twist * gain + noise * settings.disturbance * max_command * gain * _coloured_noise(
        stream, len(twist), settings.correlation
    )
    sides = np.column_stack(
        [twist[:, 0] - 0.5 * effective_track * twist[:, 1], twist[:, 0] + 0.5 * effective_track * twist[:, 1]]
    )
    radii = radius * np.array(build.twin.chassis.rolling_radii)
    wheel_speeds = sides[::stride] / radii + noise * settings.wheel_noise / radius * stream.normal(size=(count, 2))
    odometry = np.column_stack([0.5 * radius * wheel_speeds.sum(axis=1), radius * np.diff(wheel_speeds)[:, 0] / track])
    sensor = build.sensors.pose
    poses = _delayed_poses(twist, stride, sensor.latency) + noise * stream.normal(size=(count, 3)) * [
        sensor.position_sd,
        sensor.position_sd,
        sensor.heading_sd,
    ]
    fresh = np.diff(np.floor(dt * np.arange(-1, count) / max(sensor.period or dt, dt) + 1e-9)) > 0
    rate = twist[::stride, 1] + noise * (values["gyro_bias"] + settings.gyro_noise * stream.normal(size=count))
    record = Record(
        f"robot {seed}",
        0.0,
        dt,
        command,
        twist=odometry,
        yaw_rate=rate,
        pose=poses if has_pose else None,
        wheels=wheel_speeds,
        fresh_pose=fresh if has_pose else None,
    )
    train, validation = divide([record], 0.75)
    data = LogData(tuple(train), tuple(validation), ("drawn",), "the last quarter", "gyro", (), (), track)
    delays = build.twin.link.dead_time + lags.sum(axis=1)
    truth = {
        "separation_multiplier": effective_track / track,
        "left_radius_multiplier": radii[0] / radius,
        "right_radius_multiplier": radii[1] / radius,
        **{f"delay.{name}": float(value) for name, value in zip(("v", "omega"), delays, strict=True)},
        **{f"max.{name}": float(value) for name, value in zip(("v", "omega"), gain * level, strict=True)},
        **{f"rate.{name}": float(value) for name, value in zip(("v", "omega"), gain * slew, strict=True)},
    }
    reached = np.mean(np.abs(command) > level, axis=0) > 0
    return DrawnLog(data, truth, dict(zip(("max.v", "max.omega"), reached.tolist(), strict=True)))


_DRAWN_PARAMETERS = ("hold", "speed", "turning", "widening", "limit", "slew_time", "second_lag", "gyro_bias")


def _motor_response(
    commands: FloatArray, slew: FloatArray, lags: FloatArray, dead_time: float, damping: float | None
) -> FloatArray:
    """Simulate the responses (n, 2) of the motors to commands (n, 2): slew limit, dead time, and two poles."""
    ramped = np.empty_like(commands)
    current = np.zeros(2)
    for k, target in enumerate(commands):
        ramped[k] = current
        current = current + np.clip(target - current, -slew * _FINE, slew * _FINE)
    delay = round(dead_time / _FINE)
    ramped = np.concatenate([np.zeros((delay, 2)), ramped])[: len(commands)]
    for row in range(2):
        total = lags[row].sum()
        square = (0.5 * total / damping) ** 2 if damping else lags[row].prod()
        ramped[:, row] = signal.lfilter(*signal.bilinear([1.0], [square, total, 1.0], 1 / _FINE), ramped[:, row])
    return ramped


def _coloured_noise(stream: np.random.Generator, count: int, correlation: float) -> FloatArray:
    """Draw noise (count, 2) with standard deviation 1 and a correlation time [s]."""
    decay = np.exp(-_FINE / correlation)
    white = stream.normal(size=(count, 2)) * np.sqrt(1.0 - decay**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -decay], white, axis=0))


def _delayed_poses(twist: FloatArray, stride: int, latency: float) -> FloatArray:
    """Return the poses (K, 3) of each sample, delayed by `latency` [s]."""
    theta = np.cumsum(twist[:, 1]) * _FINE
    pose = np.column_stack([np.cumsum(twist[:, 0] * np.cos(theta)), np.cumsum(twist[:, 0] * np.sin(theta))]) * _FINE
    delay = round(latency / _FINE)
    poses = np.column_stack([pose, theta])
    return np.concatenate([np.zeros((delay, 3)), poses])[: len(poses)][::stride]


LOW_NOISE = 1e-3
SEED = 1


@pytest.fixture(scope="module")
def exact():
    """Return a log with almost no noise in which both channels are clipped, and its estimate."""
    log = drawn_log(SEED, noise=LOW_NOISE, seconds=60.0, limit=0.7)
    return log, estimate_stack(log.data)


def test_clean_log_determines_all_quantities(exact):
    log, quantities = exact
    for name, truth in log.truth.items():
        tolerance = 0.003 if name.startswith("delay") else 0.01 * truth
        assert quantities[name].value == pytest.approx(truth, abs=tolerance), name


def test_files_have_the_structure_of_the_packages(exact):
    files = {package: yaml.safe_load(package_text(package, exact[1])) for package in packages()}
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


def test_gyro_determines_the_multiplier_of_a_log_without_poses():
    """A body that turns more slowly for equal wheel speeds has a larger multiplier."""
    log = drawn_log(SEED, noise=LOW_NOISE, seconds=60.0, has_pose=False)
    quantities = estimate_stack(log.data)
    assert quantities["left_radius_multiplier"].value is None
    assert "pose" in quantities["left_radius_multiplier"].reason
    multiplier = quantities["separation_multiplier"].value
    assert multiplier == pytest.approx(log.truth["separation_multiplier"], rel=0.02)
    slow_records = [replace(record, yaw_rate=0.8 * record.yaw_rate) for record in log.data.train]
    slow_quantities = estimate_stack(replace(log.data, train=tuple(slow_records)))
    assert slow_quantities["separation_multiplier"].value == pytest.approx(multiplier / 0.8, rel=0.01)


def test_quantities_without_finite_intervals_have_no_value(monkeypatch):
    """With a singular covariance, estimates and derived quantities have a reason in place of a value."""
    covariance = "diffdrive_mpc_extras.stack.estimate.covariance"
    monkeypatch.setattr(covariance, lambda fit, _: np.full((len(fit.free), len(fit.free)), math.nan))
    quantities = estimate_stack(drawn_log(SEED, noise=LOW_NOISE, seconds=30.0, limit=0.7, has_pose=False).data)
    for name in ("delay.v", "delay.omega", "separation_multiplier", "max.v", "rate.omega", "look_ahead_time"):
        assert quantities[name].value is None, name
    assert all("not finite" in quantities[name].reason for name in ("max.v", "look_ahead"))
    texts = [package_text(package, quantities) for package in packages()]
    assert not any(re.search(r"\b(nan|inf)\b", text) for text in texts)
    content = yaml.safe_load(texts[list(packages()).index("nav2")])["controller_server"]["ros__parameters"]
    assert "FollowPath.lookahead_time" not in content


def test_look_ahead_gives_the_phase_margin():
    """The phase of 2 (p + 1) exp(-theta p) / p^2 at gain one is -pi plus the margin."""
    margin = math.radians(45.0)
    theta = 1.0 / look_ahead_factor(margin)
    crossover = math.sqrt(2.0 + math.sqrt(8.0))
    assert abs(2 * (1 + 1j * crossover) / crossover**2) == pytest.approx(1.0)
    assert math.atan(crossover) - theta * crossover == pytest.approx(margin)


def test_look_ahead_of_a_clipping_robot_matches_its_maximum_speed(exact):
    log, quantities = exact
    expected = quantities["look_ahead_time"].value * log.truth["max.v"]
    assert quantities["look_ahead"].value == pytest.approx(expected, rel=0.02)


def test_reason_of_a_limit_names_its_multipliers(exact):
    """If the separation multiplier is missing, the limit applies to the command before gain and multiplier."""
    log, quantities = exact
    assert "only with the separation multiplier of ros2_control.yaml" in quantities["max.omega"].reason
    records = [replace(record, wheels=None) for record in log.data.train]
    uncorrected = estimate_stack(replace(log.data, train=tuple(records)))["max.omega"]
    firmware, multiplier = draw_robot(SEED).build.firmware, log.truth["separation_multiplier"]
    level = log.truth["max.omega"] * multiplier * log.data.stated_track / firmware.track
    assert uncorrected.value == pytest.approx(level, rel=0.02)
    assert "for the multipliers of the log" in uncorrected.reason


@pytest.mark.parametrize("seed", [801, 803, 805])
def test_delays_of_overshooting_robots(seed):
    """Reserved seeds with a damping ratio of 0.4 to 0.9 and noise."""
    damping = float(np.random.default_rng(seed).uniform(0.4, 0.9))
    log = drawn_log(seed, damping=damping)
    quantities = estimate_stack(log.data)
    for name in ("delay.v", "delay.omega"):
        assert quantities[name].value == pytest.approx(log.truth[name], abs=0.01), name


def test_unknown_package_error_lists_the_known_packages(tmp_path):
    line = refusal("identify", "no.csv", "--for", "nav2,moveit", "--out", tmp_path / "x")
    assert "--for 'moveit'; known: nav2, robot_localization, ros2_control" in line


@pytest.mark.long
def test_intervals_contain_the_truth_of_drawn_robots():
    """For reserved seeds, 95 % of the errors are within the tolerances, and the coverage is consistent with 95 %."""
    tolerances, is_covered, is_accurate = POPULATION.tolerances, [], []
    for seed in range(1000, 1040, 2):
        log = drawn_log(seed)
        quantities = estimate_stack(log.data)
        for name, truth in log.truth.items():
            quantity = quantities[name]
            if quantity.value is None:
                continue
            assert log.reached.get(name, True), f"{name} is stated but was not reached"
            error = abs(quantity.value - truth) / (1.0 if name.startswith("delay") else truth)
            is_accurate.append(error <= tolerances[name.partition(".")[0]])
            is_covered.append(quantity.interval[0] <= truth <= quantity.interval[1])
    assert Rate.of_runs(sum(is_covered), len(is_covered)).high >= 0.95
    assert np.mean(is_accurate) >= 0.95
