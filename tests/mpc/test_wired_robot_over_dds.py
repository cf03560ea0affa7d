"""From the log of a robot whose gyro is upside down to a drive with the files that `identify` wrote, all over DDS."""

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
# The monitor would silence a gyro that still runs the wrong way, and the drive would hardly tell.
UNWATCHED = (("monitor.enabled", False),)


def tracked(folder, scale, remedy):
    """Drive, identify from the log with the mapping that is proposed, and drive; return configuration and metrics."""
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
    case = Case(trajectory="s", config=str(out / "config.yaml"), seed=1, overrides=UNWATCHED, **wired)
    _, plant, reference = build(case)
    drive_over_dds(case, reference.duration, folder / "drive", parameters=out / "node.yaml", **HOW)
    return load_config(out / "config.yaml"), read_drive(folder / "drive", reference, plant.sample_time).metrics


@pytest.mark.long
def test_robot_with_its_gyro_upside_down_drives_like_one_upright(tmp_path):
    upright, best = tracked(tmp_path / "upright", 1.0, remedy=False)
    turned, metrics = tracked(tmp_path / "turned", -1.0, remedy=True)
    assert (upright.sensors.yaw_rate.sign, turned.sensors.yaw_rate.sign) == (1, -1)
    assert best.completed and metrics.completed
    assert metrics.position_rmse_m < 1.2 * best.position_rmse_m
    assert metrics.lateral_max_m < 1.2 * best.lateral_max_m
