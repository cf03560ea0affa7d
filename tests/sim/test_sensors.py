"""The sensor layer: rates, latencies, noise and wrapping."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import ConfigError, Measurement
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.sensing.sensor_set import Encoders, Gyro, PoseSensor, SensorSet, load_sensor_set
from diffdrive_mpc.sim.sensing.sensors import Sensors

DT = 0.0202
KINEMATICS = WheelKinematics(0.0675, 0.330)


def _run(parameters: SensorSet, ticks: int, seed: int = 0, yaw_rate: float = 0.0) -> list[Measurement]:
    """Measurements at ticks 0 to `ticks` of a robot whose x [m] equals the time [s] after 0."""
    sensors = Sensors(parameters, KINEMATICS, DT, seed=seed, noisy_encoders=True)
    measurements = [sensors.collect(0.0, None)]
    for k in range(1, ticks + 1):
        for look in sensors.poses_due(k * DT):
            sensors.see_pose(look, [look, 0.0, 0.0])
        sensors.see_motion(k * DT, [5.0, 5.0, 5.0, 5.0], yaw_rate)
        measurements.append(sensors.collect(k * DT, None))
    return measurements


@given(period=st.one_of(st.none(), st.floats(0.005, 0.3)), latency=st.floats(0.0, 0.3))
def test_poses_arrive_at_the_first_tick_after_their_latency(period: float | None, latency: float) -> None:
    quiet = load_sensor_set("perfect")
    parameters = quiet.model_copy(
        update={"pose": PoseSensor(period=period, latency=latency, position_sd=0, heading_sd=0)}
    )
    measurements = _run(parameters, 60)
    interval = period or DT
    assert measurements[0].pose is not None
    newest = -np.inf
    for k, measurement in enumerate(measurements):
        # The newest sample that has had its latency; it is delivered once.
        expected = np.floor((k * DT - latency + 2e-9) / interval) * interval
        if measurement.pose is None:
            assert expected <= newest + 1e-6
        else:
            assert measurement.pose.time == pytest.approx(expected, abs=1e-6)
            assert measurement.pose.time > newest
            newest = measurement.pose.time
            assert np.asarray(measurement.pose.value)[0] == pytest.approx(max(newest, 0.0), abs=1e-9)


@pytest.mark.parametrize("name", ["default", "slam", "perfect"])
def test_first_measurement_is_complete_and_its_pose_not_from_the_future(name: str) -> None:
    first = _run(load_sensor_set(name), 0)[0]
    assert first.pose is not None
    assert first.wheel_twist is not None
    assert first.wheel_speeds is not None
    assert first.yaw_rate is not None
    assert first.pose.time <= 0.0
    assert first.yaw_rate.time == first.wheel_twist.time == 0.0


def test_slam_delivers_ten_poses_a_second_sixty_milliseconds_late() -> None:
    measurements = _run(load_sensor_set("slam"), 495)
    ages = [k * DT - m.pose.time for k, m in enumerate(measurements) if m.pose is not None]
    assert len(ages) == pytest.approx(100, abs=1)
    assert min(ages[1:]) >= 0.060 - 1e-9
    assert max(ages[1:]) < 0.060 + DT


def test_default_pose_is_one_sample_old() -> None:
    for k, measurement in enumerate(_run(load_sensor_set("default"), 50)):
        assert measurement.pose is not None
        assert measurement.pose.time == pytest.approx((k - 1) * DT)


def test_noise_has_the_stated_covariance() -> None:
    parameters = SensorSet(
        pose=PoseSensor(period=None, latency=0.0, position_sd=0.01, heading_sd=0.02),
        gyro=Gyro(noise_sd=0.03, bias_sd=0.0),
        encoders=Encoders(speed_sd=0.5),
    )
    n = 4000
    measurements = _run(parameters, n, yaw_rate=0.4)[1:]
    truth = {"pose": None, "wheel_twist": [5.0 * 0.0675, 0.0], "wheel_speeds": [5.0] * 4, "yaw_rate": 0.4}
    for name, mean in truth.items():
        stamped = [getattr(measurement, name) for measurement in measurements]
        values = np.array([np.atleast_1d(s.value) for s in stamped])
        errors = values - (np.atleast_1d(mean) if mean is not None else [[s.time, 0.0, 0.0] for s in stamped])
        stated = np.asarray(stamped[0].covariance)
        deviation = np.sqrt(np.diag(stated))
        # Five standard errors of a mean, of a standard deviation and of a correlation.
        assert np.all(np.abs(errors.mean(axis=0)) < 5 * deviation / np.sqrt(n)), name
        np.testing.assert_allclose(errors.std(axis=0), deviation, rtol=5 / np.sqrt(2 * n), err_msg=name)
        correlation = np.atleast_2d(np.corrcoef(errors.T)) - stated / np.outer(deviation, deviation)
        assert np.abs(correlation).max() < 5 / np.sqrt(n), name
        np.testing.assert_array_equal(stated, stated.T)


def test_gyro_bias_is_constant_in_a_run_and_differs_between_seeds() -> None:
    quiet = load_sensor_set("perfect")
    parameters = quiet.model_copy(update={"gyro": Gyro(noise_sd=0.0, bias_sd=0.01)})
    biases = []
    for seed in range(200):
        rates = {float(np.asarray(m.yaw_rate.value)) for m in _run(parameters, 3, seed) if m.yaw_rate is not None}
        assert len(rates - {0.0}) == 1
        biases.append(rates.pop())
    assert np.std(biases) == pytest.approx(0.01, rel=0.25)


def test_changing_one_sensor_leaves_the_noise_of_the_others() -> None:
    default, slam = (_run(load_sensor_set(name), 30, seed=3) for name in ("default", "slam"))
    for one, other in zip(default, slam, strict=True):
        assert one.yaw_rate is not None and other.yaw_rate is not None
        assert one.wheel_speeds is not None and other.wheel_speeds is not None
        assert one.yaw_rate.value == other.yaw_rate.value
        np.testing.assert_array_equal(one.wheel_speeds.value, other.wheel_speeds.value)


@given(theta=st.floats(-50.0, 50.0))
def test_reported_heading_is_wrapped(theta: float) -> None:
    sensors = Sensors(load_sensor_set("perfect"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    sensors.reset([1.0, 2.0, theta], np.zeros(4))
    pose = sensors.collect(0.0, None).pose
    assert pose is not None
    reported = float(np.asarray(pose.value)[2])
    assert -np.pi < reported <= np.pi
    assert np.cos(reported - theta) == pytest.approx(1.0, abs=1e-9)


def test_heading_of_exactly_half_a_turn_is_reported_positive() -> None:
    sensors = Sensors(load_sensor_set("perfect"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    for theta in (np.pi, -np.pi):
        sensors.reset([0.0, 0.0, theta], np.zeros(4))
        pose = sensors.collect(0.0, None).pose
        assert pose is not None
        assert np.asarray(pose.value)[2] == np.pi


def test_nothing_is_delivered_twice() -> None:
    sensors = Sensors(load_sensor_set("default"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    sensors.collect(0.0, None)
    assert sensors.collect(0.0, (0.1, 0.2)) == Measurement(sent=(0.1, 0.2))


def _file(folder: Path, period: str, latency: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(
        f"pose: {{period: {period}, latency: {latency}, position_sd: 0.01, heading_sd: 0.01}}\n"
        "gyro: {noise_sd: 0.0, bias_sd: 0.0}\nencoders: {speed_sd: 0.0}\n"
    )
    return path


@pytest.mark.parametrize(
    ("period", "latency", "key"),
    [
        ("1.0e-7", "0.02", "pose.period"),
        ("0", "0.02", "pose.period"),
        ("-0.1", "0.02", "pose.period"),
        ("0.1", "1.0e+9", "pose.latency"),
        ("0.1", "2.01", "pose.latency"),
        ("0.1", "-0.01", "pose.latency"),
    ],
)
def test_a_pose_sensor_that_would_never_end_is_refused(period: str, latency: str, key: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"mine\.yaml: {key}: [^\n]*\(found [^\n]*\)$"):
        load_sensor_set(_file(tmp_path, period, latency))


def test_the_fastest_and_latest_pose_sensor_works(tmp_path: Path) -> None:
    measurements = _run(load_sensor_set(_file(tmp_path, "0.001", "2.0")), 200)
    for k, measurement in enumerate(measurements):
        assert measurement.pose is not None
        assert k * DT - measurement.pose.time == pytest.approx(2.0, abs=1.1e-3)
