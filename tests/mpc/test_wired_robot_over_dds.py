"""Log of a robot with an inverted gyro, identification, and a drive with the resulting files, all over DDS."""

import pytest
import yaml
from recorded_drive import read_drive
from two_processes import drive_over_dds

from commands import call
from diffdrive_mpc import load_config
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build

TOPICS = {"odometry": "/odom", "imu": "/imu", "pose": "/pose"}
HOW = {"lock_step": True, "timeout": 200.0}
# The monitor would disable a gyro with a wrong sign, which would hide the fault in the drive.
WITHOUT_MONITOR = (("monitor.enabled", False),)


def identify_and_drive(folder, scale, remedy):
    """Drive, identify from the log with the proposed mapping, and drive; return configuration and metrics."""
    sensors, mapping, out = folder / "sensors.yaml", folder / "mapping.yaml", folder / "robot"
    folder.mkdir()
    sensors.write_text(yaml.safe_dump({"gyro": {"scale": scale}}), encoding="utf-8")
    mapping.write_text(yaml.safe_dump({"topics": TOPICS}), encoding="utf-8")
    wired = {"sensors": str(sensors), "model": "sm"}
    drive_over_dds(Case(trajectory="excitation", **wired), 40.0, folder / "log", **HOW)
    if remedy:
        call("identify", folder / "log", "--mapping", mapping, "--out", out, code=2)
        mapping = out / "fixed.yaml"
    call("identify", folder / "log", "--mapping", mapping, "--out", out)
    node = yaml.safe_load((out / "node.yaml").read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    assert node["use_imu"] is True and node["pose_source"] == "topic"
    case = Case(trajectory="s", config=str(out / "config.yaml"), seed=1, overrides=WITHOUT_MONITOR, **wired)
    _, plant, reference = build(case)
    drive_over_dds(case, reference.duration, folder / "drive", parameters=out / "node.yaml", **HOW)
    return load_config(out / "config.yaml"), read_drive(folder / "drive", reference, plant.sample_time).metrics


@pytest.mark.long
def test_robot_with_an_inverted_gyro_drives_like_an_upright_one(tmp_path):
    upright, best = identify_and_drive(tmp_path / "upright", 1.0, remedy=False)
    inverted, metrics = identify_and_drive(tmp_path / "turned", -1.0, remedy=True)
    assert (upright.sensors.yaw_rate.sign, inverted.sensors.yaw_rate.sign) == (1, -1)
    assert best.completed and metrics.completed
    assert metrics.position_rmse_m < 1.2 * best.position_rmse_m
    assert metrics.lateral_max_m < 1.2 * best.lateral_max_m
