"""Sensors: measurements and faults."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import Measurement, Stamped, make_plant
from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.sensing.sensor_set import Encoders, Gyro, PoseSensor, SensorSet, load_sensor_set
from diffdrive_mpc.sim.sensing.sensors import Sensors

DT = 0.0202
KINEMATICS = WheelKinematics(0.0675, 0.330)


def _run(parameters: SensorSet, ticks: int, seed: int = 0, yaw_rate: float = 0.0) -> list[Measurement]:
    """Return the measurements at ticks 0 to `ticks` of a robot whose x [m] equals the time [s] after 0."""
    sensors = Sensors(parameters, KINEMATICS, DT, seed=seed, noisy_encoders=True)
    measurements = [sensors.collect(0.0, None)]
    for k in range(1, ticks + 1):
        for pose_time in sensors.poses_due(k * DT):
            sensors.add_pose(pose_time, [pose_time, 0.0, 0.0])
        sensors.add_motion(k * DT, [5.0, 5.0, 5.0, 5.0], yaw_rate)
        measurements.append(sensors.collect(k * DT, None))
    return measurements


@given(period=st.one_of(st.none(), st.floats(0.005, 0.3)), latency=st.floats(0.0, 0.3))
def test_poses_arrive_at_the_first_tick_after_their_latency(period: float | None, latency: float) -> None:
    perfect = load_sensor_set("perfect")
    parameters = perfect.model_copy(
        update={"pose": PoseSensor(period=period, latency=latency, position_sd=0, heading_sd=0)}
    )
    measurements = _run(parameters, 60)
    interval = period or DT
    assert measurements[0].pose is not None
    newest = -np.inf
    for k, measurement in enumerate(measurements):
        # The newest sample whose latency has passed is delivered once.
        expected = np.floor((k * DT - latency + 2e-9) / interval) * interval
        if measurement.pose is None:
            assert expected <= newest + 1e-6
        else:
            assert measurement.pose.time == pytest.approx(expected, abs=1e-6)
            assert measurement.pose.time > newest
            newest = measurement.pose.time
            assert np.asarray(measurement.pose.value)[0] == pytest.approx(max(newest, 0.0), abs=1e-9)


def test_sensor_set_defines_the_wiring_of_sensors() -> None:
    wired = load_sensor_set("perfect").model_dump()
    wired["pose"] |= {"turned": 0.5, "mirrored": True, "theta_sign": -1}
    wired["gyro"] |= {"scale": -2.0, "largest": 1.0}
    wired["encoders"] |= {"left": -1.0, "right": 0.5, "swapped": True}
    sensors = Sensors(check(SensorSet, wired, "set"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    for rate, expected in ((0.3, -0.6), (0.7, -1.0), (-0.7, 1.0)):
        sensors.add_motion(DT, [1.0, 2.0, 3.0, 4.0], rate)
        reading = sensors.collect(DT, None).yaw_rate
        assert reading is not None
        assert reading.value == pytest.approx(expected)
    (time,) = sensors.poses_due(DT)
    sensors.add_pose(time, [1.0, 2.0, 0.1])
    sensors.add_motion(DT, [1.0, 2.0, 3.0, 4.0], 0.0)
    measured = sensors.collect(DT, None)
    assert measured.wheel_speeds is not None and measured.pose is not None
    assert np.array_equal(measured.wheel_speeds.value, [-2.0, 0.5, -4.0, 1.5])
    assert np.asarray(measured.pose.value) == pytest.approx([1.0, -2.0, 0.4])


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
    perfect = load_sensor_set("perfect")
    parameters = perfect.model_copy(update={"gyro": Gyro(noise_sd=0.0, bias_sd=0.01)})
    biases = []
    for seed in range(200):
        rates = {float(np.asarray(m.yaw_rate.value)) for m in _run(parameters, 3, seed) if m.yaw_rate is not None}
        assert len(rates - {0.0}) == 1
        biases.append(rates.pop())
    assert np.std(biases) == pytest.approx(0.01, rel=0.25)


def test_change_of_one_sensor_does_not_change_the_noise_of_others() -> None:
    default, slam = (_run(load_sensor_set(name), 30, seed=3) for name in ("default", "slam"))
    for expected, actual in zip(default, slam, strict=True):
        assert expected.yaw_rate.value == actual.yaw_rate.value
        np.testing.assert_array_equal(expected.wheel_speeds.value, actual.wheel_speeds.value)


@given(theta=st.floats(-50.0, 50.0))
def test_reported_heading_is_wrapped(theta: float) -> None:
    sensors = Sensors(load_sensor_set("perfect"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    sensors.reset([1.0, 2.0, theta], np.zeros(4))
    pose = sensors.collect(0.0, None).pose
    reported = float(np.asarray(pose.value)[2])
    assert -np.pi < reported <= np.pi
    assert np.cos(reported - theta) == pytest.approx(1.0, abs=1e-9)


def test_measurement_is_delivered_once() -> None:
    sensors = Sensors(load_sensor_set("default"), KINEMATICS, DT, seed=0, noisy_encoders=True)
    sensors.collect(0.0, None)
    assert sensors.collect(0.0, (0.1, 0.2)) == Measurement(sent=(0.1, 0.2))


FIELDS = ("pose", "wheel_twist", "wheel_speeds", "yaw_rate")
START, END = 0.5, 1.0


def _drive(plant: Plant, ticks: int = 75) -> list[tuple[float, Measurement, list[float]]]:
    """Return time, measurement and true pose of each tick of a curve."""
    plant.reset(np.zeros(3))
    samples = []
    for _ in range(ticks):
        samples.append((plant.time, plant.measure(), plant.true_pose.tolist()))
        plant.advance([0.4, 0.3])
    return samples


def _value(stamped: Stamped | None) -> list[float] | None:
    return None if stamped is None else np.atleast_1d(np.asarray(stamped.value, dtype=float)).tolist()


@pytest.mark.parametrize(("name", "noise"), [("noise_2cm", 0.02), ("noise_5cm", 0.05)])
def test_unstated_noise_is_not_in_the_covariance(name: str, noise: float) -> None:
    samples = [
        (np.asarray(m.pose.value), m.pose, truth)
        for _, m, truth in _drive(make_plant("mujoco", sensors=name), 400)
        if m.pose
    ]
    errors = np.array([value[:2] - truth[:2] for value, _, truth in samples])
    assert errors.std() == pytest.approx(noise, rel=0.1)
    stated = np.sqrt(np.diag(np.asarray(samples[0][1].covariance)))
    pose_sensor = load_sensor_set("default").pose
    np.testing.assert_allclose(stated, [pose_sensor.position_sd, pose_sensor.position_sd, pose_sensor.heading_sd])


def _drive_pair(name: str, **faults: Any) -> list[tuple[float, Measurement, Measurement]]:
    """Return time, intact and faulty measurement of each tick; the states of both robots are bitwise equal."""
    for fault in (fault for entries in faults.values() for fault in entries):
        fault |= {"start": START, "duration": END - START}
    scenario = check(Scenario, {"description": "test", **faults}, "test")
    healthy = _drive(make_plant(name, seed=1))
    faulty = _drive(DisturbedPlant(make_plant(name, seed=1), scenario, load_robot()))
    assert [true for _, _, true in healthy] == [true for _, _, true in faulty]
    return [(time, intact, affected) for (time, intact, _), (_, affected, _) in zip(healthy, faulty, strict=True)]


def _check_only(
    ticks: list[tuple[float, Measurement, Measurement]], fields: set[str]
) -> list[tuple[float, Measurement, Measurement]]:
    """Check that only these fields differ, only during the fault, with equal stamps; return the ticks of the fault."""
    during = [tick for tick in ticks if START <= tick[0] < END]
    assert 20 < len(during) < len(ticks)
    for time, intact, faulty in ticks:
        for field in FIELDS:
            expected, actual = getattr(intact, field), getattr(faulty, field)
            assert (expected is None) == (actual is None)
            if expected is not None:
                assert expected.time == actual.time
                assert expected.covariance is actual.covariance or np.array_equal(
                    expected.covariance, actual.covariance
                )
                if not (START <= time < END and field in fields):
                    assert _value(expected) == _value(actual), (field, time)
    for field in fields:
        assert all(_value(getattr(intact, field)) != _value(getattr(faulty, field)) for _, intact, faulty in during[1:])
    return during


@pytest.mark.parametrize("plant", ["mujoco", "model:ssm"])
@pytest.mark.parametrize(
    ("sensor", "fields"), [("pose", {"pose"}), ("wheels", {"wheel_twist", "wheel_speeds"}), ("gyro", {"yaw_rate"})]
)
def test_stuck_sensor_repeats_its_last_value_with_new_stamps(plant: str, sensor: str, fields: set[str]) -> None:
    ticks = _drive_pair(plant, stuck_sensors=[{"sensor": sensor}])
    during = _check_only(ticks, fields)
    last = [intact for time, intact, _ in ticks if time < START][-1]
    for field in fields:
        assert {tuple(_value(getattr(faulty, field)) or ()) for _, _, faulty in during} == {
            tuple(_value(getattr(last, field)) or ())
        }
        stamps = [getattr(faulty, field).time for _, _, faulty in during]
        assert stamps == sorted(set(stamps))


def test_dead_encoder_corrupts_the_twist_of_its_side() -> None:
    during = _check_only(
        _drive_pair("mujoco", dead_encoders=[{"wheels": ["rear_left"]}]), {"wheel_twist", "wheel_speeds"}
    )
    robot = load_robot()
    for _, intact, faulty in during:
        speeds = np.asarray(intact.wheel_speeds.value) * [1, 1, 0, 1]  # type: ignore[union-attr]
        assert _value(faulty.wheel_speeds) == speeds.tolist()
        left, right = robot.wheel_radius * speeds.reshape(2, 2).mean(axis=0)
        np.testing.assert_allclose(_value(faulty.wheel_twist), [(left + right) / 2, (right - left) / robot.track])


def test_biased_gyro_has_a_constant_error() -> None:
    for _, intact, faulty in _check_only(_drive_pair("mujoco", gyro_biases=[{"bias": 0.05}]), {"yaw_rate"}):
        assert _value(faulty.yaw_rate)[0] - _value(intact.yaw_rate)[0] == pytest.approx(0.05)  # type: ignore[index]


def test_pose_error_jumps_and_drifts_from_its_start_and_the_heading_stays_wrapped() -> None:
    error = {"x": 0.3, "y": -0.2, "heading": 6.0, "x_rate": 0.1, "heading_rate": -0.5}
    for time, intact, faulty in _check_only(_drive_pair("mujoco", pose_errors=[error]), {"pose"}):
        difference = np.subtract(_value(faulty.pose), _value(intact.pose))  # type: ignore[arg-type]
        elapsed = time - START
        np.testing.assert_allclose(difference[:2], [0.3 + 0.1 * elapsed, -0.2], atol=1e-12)
        assert np.cos(difference[2] - 6.0 + 0.5 * elapsed) == pytest.approx(1.0)
        assert -np.pi < _value(faulty.pose)[2] <= np.pi  # type: ignore[index]


def test_sensor_that_is_stuck_after_a_drop_out_repeats_its_last_reading() -> None:
    drop_out, stuck = {"sensor": "gyro", "start": 0.0, "duration": 0.5}, {"sensor": "gyro", "start": 0.3}
    faults = {"description": "test", "drop_outs": [drop_out], "stuck_sensors": [stuck]}
    scenario = check(Scenario, faults, "test")
    samples = _drive(DisturbedPlant(make_plant("model:ssm"), scenario, load_robot()))
    rates = [_value(m.yaw_rate) for time, m, _ in samples if time >= 0.5]
    assert all(m.yaw_rate is None for time, m, _ in samples if time < 0.5)
    assert rates[0] is not None
    assert all(rate == rates[0] for rate in rates)
