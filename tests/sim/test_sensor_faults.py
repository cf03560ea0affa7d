"""Sensors that are poor from the start, and sensors that fail while the robot drives on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diffdrive_mpc import Measurement, Stamped, make_plant
from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.disturbances.scenario import Scenario, load_scenario
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set

DT = load_robot().sample_time
FIELDS = ("pose", "wheel_twist", "wheel_speeds", "yaw_rate")
START, END = 0.5, 1.0


def _drive(plant: Plant, ticks: int = 75) -> list[tuple[float, Measurement, list[float]]]:
    """Time, measurement and true pose of each tick of a curve."""
    plant.reset(np.zeros(3))
    seen = []
    for _ in range(ticks):
        seen.append((plant.time, plant.measure(), plant.true_pose.tolist()))
        plant.advance([0.4, 0.3])
    return seen


def _value(stamped: Stamped | None) -> list[float] | None:
    return None if stamped is None else np.atleast_1d(np.asarray(stamped.value, dtype=float)).tolist()


@pytest.mark.parametrize(
    ("name", "rate", "age"),
    [
        ("poses_2hz", 2, 0.02),
        ("poses_5hz", 5, 0.02),
        ("poses_10hz", 10, 0.02),
        ("poses_20hz", 20, 0.02),
        ("poses_100ms", 1 / DT, 0.1),
        ("poses_200ms", 1 / DT, 0.2),
        ("poses_50hz_200ms", 1 / DT, 0.2),
        ("poses_5hz_350ms", 5, 0.35),
        ("poses_100ms_arrival", 1 / DT, 0.0),
        ("poses_200ms_arrival", 1 / DT, 0.0),
    ],
)
def test_poor_poses_arrive_as_often_and_as_old_as_their_name_says(name: str, rate: float, age: float) -> None:
    """Ages by the stamp; how old a pose really is shows its place: it is where the robot was that long ago."""
    latency = load_sensor_set(name).pose.latency
    seen = _drive(make_plant("mujoco", sensors=name), 300)[1:]
    arrived = [(time, m.pose) for time, m, _ in seen if m.pose is not None]
    assert len(arrived) == pytest.approx(rate * len(seen) * DT, rel=0.03, abs=1)
    ages = np.array([time - pose.time for time, pose in arrived])
    assert ages.min() >= age - 1e-9
    assert ages.max() < age + DT + 1e-9
    times, truth = np.array([time for time, _, _ in seen]), np.array([pose for _, _, pose in seen])
    late = [(time, np.asarray(pose.value)) for time, pose in arrived if time > latency + 0.1]
    # The instant that a pose shows, by where it is along the way: of the noise the mean over many.
    then = [np.argmin(np.hypot(*(truth[:, :2] - pose[:2]).T)) for _, pose in late]
    assert np.mean([time - times[k] for (time, _), k in zip(late, then, strict=True)]) == pytest.approx(
        latency + DT / 2, abs=DT
    )


@pytest.mark.parametrize(("name", "noise"), [("noise_2cm", 0.02), ("noise_5cm", 0.05)])
def test_noise_that_is_not_stated(name: str, noise: float) -> None:
    seen = [
        (np.asarray(m.pose.value), m.pose, truth)
        for _, m, truth in _drive(make_plant("mujoco", sensors=name), 400)
        if m.pose
    ]
    errors = np.array([value[:2] - truth[:2] for value, _, truth in seen])
    assert errors.std() == pytest.approx(noise, rel=0.1)
    stated = np.sqrt(np.diag(np.asarray(seen[0][1].covariance)))
    usual = load_sensor_set("default").pose
    np.testing.assert_allclose(stated, [usual.position_sd, usual.position_sd, usual.heading_sd])


def test_a_sensor_set_says_only_what_differs_from_the_default_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("gyro: {bias_sd: 0.02}\n")
    mine, usual = load_sensor_set(path), load_sensor_set("default")
    assert mine.gyro.bias_sd == 0.02
    assert mine.gyro.noise_sd == usual.gyro.noise_sd
    assert (mine.pose, mine.encoders) == (usual.pose, usual.encoders)
    path.write_text("pose: {latncy: 0.1}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: unknown key 'pose\.latncy'; did you mean 'pose\.latency'\?$"):
        load_sensor_set(path)
    path.write_text("encoders: {speed_sd: 1.0e+299}\n")
    with pytest.raises(ConfigError, match=r"encoders\.speed_sd: .* less than or equal to 1000"):
        load_sensor_set(path)


def _both(name: str, **faults: Any) -> list[tuple[float, Measurement, Measurement]]:
    """Time, sound and faulty measurement of each tick; the robots are the same in every bit."""
    for fault in (one for kind in faults.values() for one in kind):
        fault |= {"start": START, "duration": END - START}
    scenario = check(Scenario, {"description": "test", **faults}, "test")
    sound = _drive(make_plant(name, seed=1))
    faulty = _drive(DisturbedPlant(make_plant(name, seed=1), scenario, load_robot()))
    assert [true for _, _, true in sound] == [true for _, _, true in faulty]
    return [(time, one, other) for (time, one, _), (_, other, _) in zip(sound, faulty, strict=True)]


def _check_only(
    seen: list[tuple[float, Measurement, Measurement]], fields: set[str]
) -> list[tuple[float, Measurement, Measurement]]:
    """The ticks of the fault, after a check that it changes these fields then and nothing else, and no stamp at all."""
    during = [one for one in seen if START <= one[0] < END]
    assert 20 < len(during) < len(seen)
    for time, sound, faulty in seen:
        for field in FIELDS:
            one, other = getattr(sound, field), getattr(faulty, field)
            assert (one is None) == (other is None)
            if one is not None:
                assert one.time == other.time
                assert one.covariance is other.covariance or np.array_equal(one.covariance, other.covariance)
                if not (START <= time < END and field in fields):
                    assert _value(one) == _value(other), (field, time)
    for field in fields:
        assert all(_value(getattr(sound, field)) != _value(getattr(faulty, field)) for _, sound, faulty in during[1:])
    return during


@pytest.mark.parametrize("plant", ["mujoco", "model:ssm"])
@pytest.mark.parametrize(
    ("sensor", "fields"), [("pose", {"pose"}), ("wheels", {"wheel_twist", "wheel_speeds"}), ("gyro", {"yaw_rate"})]
)
def test_a_stuck_sensor_repeats_its_last_value_with_fresh_stamps(plant: str, sensor: str, fields: set[str]) -> None:
    seen = _both(plant, stuck_sensors=[{"sensor": sensor}])
    during = _check_only(seen, fields)
    last = [sound for time, sound, _ in seen if time < START][-1]
    for field in fields:
        assert {tuple(_value(getattr(faulty, field)) or ()) for _, _, faulty in during} == {
            tuple(_value(getattr(last, field)) or ())
        }
        stamps = [getattr(faulty, field).time for _, _, faulty in during]
        assert stamps == sorted(set(stamps))


def test_a_dead_encoder_spoils_the_twist_of_its_side() -> None:
    during = _check_only(_both("mujoco", dead_encoders=[{"wheels": ["rear_left"]}]), {"wheel_twist", "wheel_speeds"})
    robot = load_robot()
    for _, sound, faulty in during:
        speeds = np.asarray(sound.wheel_speeds.value) * [1, 1, 0, 1]  # type: ignore[union-attr]
        assert _value(faulty.wheel_speeds) == speeds.tolist()
        left, right = robot.wheel_radius * speeds.reshape(2, 2).mean(axis=0)
        np.testing.assert_allclose(_value(faulty.wheel_twist), [(left + right) / 2, (right - left) / robot.track])


def test_wheels_that_read_zero_read_nothing_else() -> None:
    wheels = load_scenario("dead_wheels").draw(0).dead_encoders[0].wheels
    for _, _, faulty in _check_only(
        _both("mujoco", dead_encoders=[{"wheels": wheels}]), {"wheel_twist", "wheel_speeds"}
    ):
        assert _value(faulty.wheel_speeds) == [0.0] * 4
        assert _value(faulty.wheel_twist) == [0.0] * 2


def test_a_biased_gyro_is_off_by_a_constant() -> None:
    for _, sound, faulty in _check_only(_both("mujoco", gyro_biases=[{"bias": 0.05}]), {"yaw_rate"}):
        assert _value(faulty.yaw_rate)[0] - _value(sound.yaw_rate)[0] == pytest.approx(0.05)  # type: ignore[index]


def test_a_pose_jumps_and_drifts_from_then_on_and_its_heading_stays_wrapped() -> None:
    error = {"x": 0.3, "y": -0.2, "heading": 6.0, "x_rate": 0.1, "heading_rate": -0.5}
    for time, sound, faulty in _check_only(_both("mujoco", pose_errors=[error]), {"pose"}):
        off = np.subtract(_value(faulty.pose), _value(sound.pose))  # type: ignore[arg-type]
        since = time - START
        np.testing.assert_allclose(off[:2], [0.3 + 0.1 * since, -0.2], atol=1e-12)
        assert np.cos(off[2] - 6.0 + 0.5 * since) == pytest.approx(1.0)
        assert -np.pi < _value(faulty.pose)[2] <= np.pi  # type: ignore[index]


def test_a_sensor_that_is_lost_and_then_stuck_repeats_what_came_last(tmp_path: Path) -> None:
    scenario = check(
        Scenario,
        {
            "description": "test",
            "drop_outs": [{"sensor": "gyro", "start": 0.0, "duration": 0.5}],
            "stuck_sensors": [{"sensor": "gyro", "start": 0.3}],
        },
        "test",
    )
    seen = _drive(DisturbedPlant(make_plant("model:ssm"), scenario, load_robot()))
    rates = [_value(m.yaw_rate) for time, m, _ in seen if time >= 0.5]
    assert all(m.yaw_rate is None for time, m, _ in seen if time < 0.5)
    assert rates[0] is not None
    assert all(rate == rates[0] for rate in rates)


LASTING = "frozen_pose drifting_pose pose_jump dead_wheels stuck_wheels dead_encoder stuck_gyro biased_gyro"


@pytest.mark.parametrize("name", [*LASTING.split(), "dead_motor"])
def test_the_shipped_faults_last_to_the_end(name: str) -> None:
    (span,) = load_scenario(name).draw(0).spans
    assert 3.0 <= span[0] <= 4.0
    assert span[1] == np.inf
