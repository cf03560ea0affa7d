"""Sensors wired differently than stated are detected, corrected, and written to the configuration of the robot."""

import numpy as np
import pytest
import yaml
from identification_parts import DT, set_points

from commands import call
from diffdrive_mpc import Controller, identify, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.models.identification.advice import AdvisedError
from diffdrive_mpc.models.identification.fit.sensors import find_corrections, stated_corrections
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.sim.log_mcap import write_log

COLUMNS = {
    "time": "t",
    "command": {"v": "v", "omega": "w"},
    "encoders": {"v": "wheels_v", "omega": "wheels_w"},
    "gyro": {"yaw_rate": "gyro"},
    "pose": {"time": "seen", "x": "x", "y": "y", "theta": "theta"},
}


def drive(*, gyro=1.0, wheels=1.0, late=0, max_rate=np.inf, seed=0):
    """Return a record of 60 s in which wheels turn a fifth more than the body, and poses are `late` samples late."""
    rng = np.random.default_rng(seed)
    command = set_points(seed, 3000, [0.5, 0.8])
    body = np.zeros_like(command)
    for k in range(1, len(command)):
        body[k] = body[k - 1] + DT / 0.15 * (command[k - 1] - body[k - 1])
    pose = np.zeros((len(command), 3))
    for k, (v, omega) in enumerate(0.5 * (body[1:] + body[:-1])):
        pose[k + 1] = integrate_pose(pose[k], v, omega, DT)
    pose = np.roll(pose, late, axis=0)[late:] + rng.normal(0.0, [0.005, 0.005, 0.005], (len(pose) - late, 3))
    yaw_rate = np.clip(gyro * body[:, 1] + rng.normal(0.0, 0.005, len(body)), -max_rate, max_rate)
    twist = wheels * body * [1.0, 1.2] + rng.normal(0.0, 0.01, body.shape)
    return Record("drive", 0.0, DT, command[late:], twist=twist[late:], yaw_rate=yaw_rate[late:], pose=pose)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {}),
        ({"gyro": 0.77}, {"yaw_rate": {"scale": 0.77}}),
        ({"gyro": 180 / np.pi}, {}),
        ({"wheels": 0.7}, {"wheels": {"scale": 0.7}}),
        ({"late": 1}, {"pose": {"delay": DT}}),
        ({"late": 6, "gyro": 1.3}, {"yaw_rate": {"scale": 1.3}, "pose": {"delay": 6 * DT}}),
        ({"late": 10}, {"pose": {"delay": 10 * DT}}),
    ],
)
def test_wiring_differences_are_detected_and_corrected(changes, expected):
    record = drive(**changes)
    corrections = find_corrections("drive", [record], None)
    assert corrections.settings.keys() == expected.keys()
    for name, values in expected.items():
        assert corrections.settings[name] == pytest.approx(values, rel=0.02, abs=0.004)
    assert len(corrections.findings) == sum(map(len, expected.values()))
    repeated = find_corrections("drive", corrections.correct([record]), None)
    assert repeated.settings == {}


def test_saturated_gyro_has_no_scale():
    corrections = find_corrections("drive", [drive(max_rate=0.3)], None)
    assert corrections.settings == {}
    assert ["increase its range" in str(finding) for finding in corrections.findings] == [True]


def test_mapping_corrections_are_stated_for_the_robot():
    columns = COLUMNS | {"gyro": {"yaw_rate": {"column": "gyro", "sign": -1}, "delay": 0.02}}
    columns["encoders"] = {"v": "wheels_v", "omega": {"column": "wheels_w", "sign": -1}}
    columns["pose"] = {**COLUMNS["pose"], "delay": 0.1, "heading_offset": 0.5}
    assert stated_corrections(LogMapping(columns=columns)) == {
        "yaw_rate": {"sign": -1, "delay": 0.02},
        "wheels": {"turn_sign": -1},
        "pose": {"heading": 0.5, "delay": 0.1},
    }
    topics = {"imu": {"topic": "/imu", "sign": -1}, "pose": {"topic": "/pose", "delay": 0.05}}
    assert stated_corrections(LogMapping(topics=topics)) == {"yaw_rate": {"sign": -1}, "pose": {"delay": 0.05}}
    assert stated_corrections(None) == {}


@pytest.mark.system
def test_log_of_a_miswired_robot_gives_a_configuration_that_corrects_it(tmp_path):
    """The log of an inverted gyro and of poses stamped on arrival determines the settings of the controller."""
    wired = {"gyro": {"scale": -1.0}, "pose": {"latency": 0.11, "stamped_on_arrival": True}}
    (tmp_path / "sensors.yaml").write_text(yaml.safe_dump(wired), encoding="utf-8")
    plant = make_plant("mujoco", seed=3, sensors=tmp_path / "sensors.yaml")
    plant.reset((0.0, 0.0, 0.0))
    rows = ["t,v,w,wheels_v,wheels_w,gyro,seen,x,y,theta"]
    for command in set_points(1, 2500, [0.5, 0.8]):
        m = plant.measure()
        pose = ["", "", "", ""] if m.pose is None else [m.pose.time, *m.pose.value]
        cells = [plant.time, *command, *m.wheel_twist.value, m.yaw_rate.value, *pose]
        rows.append(",".join(str(cell) for cell in cells))
        plant.advance(command)
    (tmp_path / "drive.csv").write_text("\n".join(rows), encoding="utf-8")
    gyro = {"yaw_rate": {"column": "gyro", "sign": -1}}
    for name, columns in (("plain.yaml", COLUMNS), ("turned.yaml", COLUMNS | {"gyro": gyro})):
        (tmp_path / name).write_text(yaml.safe_dump({"columns": columns}), encoding="utf-8")
    output = call("log", "check", tmp_path / "drive.csv", "--mapping", tmp_path / "plain.yaml", code=1)
    assert "omega of the gyro has the opposite sign to the command" in output and "`yaw_rate.sign: -1`" in output
    output = call("log", "check", tmp_path / "drive.csv", "--mapping", tmp_path / "turned.yaml")
    assert "yaw_rate: {sign: -1}" in output and "pose: {delay: 0.1" in output
    # The comparison of speeds also detects the delay, less accurately.
    assert "older than their stamps" in output and "later than" not in output
    identify(tmp_path / "drive.csv", tmp_path / "turned.yaml").write(tmp_path / "robot")
    sensors = load_config(tmp_path / "robot" / "config.yaml").sensors
    assert sensors.yaw_rate.sign == -1
    assert sensors.pose.delay == pytest.approx(0.11, abs=0.01)


@pytest.mark.parametrize(
    "sensors",
    [
        {"pose": {"delay": 0.3}},
        {"pose": {"heading": 1.0}, "yaw_rate": {"scale": 0.5, "sign": -1}},
        {"wheels": {"scale": 2.0, "sign": -1}},
        {"wheels": {"scale": 2.0, "turn_sign": -1}},
    ],
)
def test_simulated_sensors_have_the_errors_that_the_configuration_corrects(sensors):
    controller = Controller("sm", sensors=sensors, **{"estimator.history": 0.7, "failure.max_pose_age": 0.8})
    run = simulate(controller, "model:sm", "s")
    assert run.metrics.completed and run.metrics.position_max_m < 0.02


def test_record_of_a_drive_with_an_inverted_gyro_gives_a_configuration_that_corrects_it(tmp_path):
    """The record contains uncorrected readings, even if the controller of the drive applied the sign."""
    (tmp_path / "sensors.yaml").write_text("gyro: {scale: -1.0}", encoding="utf-8")
    controller = Controller(load_config("sm", {"sensors.yaw_rate.sign": -1}))
    plant = make_plant("mujoco", seed=3, sensors=tmp_path / "sensors.yaml")
    write_log(simulate(controller, plant, load_trajectory("figure8")), tmp_path / "drive.mcap")
    with pytest.raises(AdvisedError, match="has the opposite sign to the command") as error:
        identify(tmp_path / "drive.mcap")
    error.value.advice.write(tmp_path)
    identify(tmp_path / "drive.mcap", tmp_path / "fixed.yaml").write(tmp_path)
    assert load_config(tmp_path / "config.yaml").sensors.yaw_rate.sign == -1
