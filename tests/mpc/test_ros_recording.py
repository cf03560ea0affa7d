"""Recordings of the node: contents, files, and independence of the drive."""

import numpy as np
import pytest
from ros_parts import DT, stack

from diffdrive_mpc.models.logs.bag_topics import COMMANDS, TopicRequest, open_bag, read_topics
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.logs.drive_log.topics import DIAGNOSTICS, PLAN, REFERENCE, TRUE_POSE
from diffdrive_mpc.models.logs.mapping import Topic


def record_drive(folder, ticks, **parameters):
    """Drive along the circle; return the file and the commands that the base received."""
    # Diagnostics use wall time; a fast machine completes the drive in less than a second.
    settings = {"record": True, "record_folder": str(folder), "diagnostics_rate": 20.0}
    with stack(drive=True, **settings, **parameters) as s:
        s.base.run(ticks)
        received = [*zip(s.base.times, s.base.commands, strict=True)]
    (path,) = folder.iterdir()
    return path, received


@pytest.mark.parametrize("pose_topic", [pytest.param(False, marks=pytest.mark.system), True])
def test_recording_contains_commands_and_measurements(tmp_path, pose_topic):
    path, received = record_drive(tmp_path / "drives", 150, pose_topic=pose_topic)
    log = read_drive_log(path, plans=True)
    assert not log.cut and log.pose_sensor == pose_topic
    columns = log.columns
    commands = np.column_stack([columns["v_ref_m_s"], columns["omega_ref_rad_s"]])
    with open_bag(path) as reader:
        (samples,) = read_topics(reader, path, {"command": TopicRequest(Topic(topic="/cmd_vel"), COMMANDS)}).values()
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    assert np.array_equal(samples.value, commands)
    commands_by_stamp = dict(received)
    common = [row for row, stamp in enumerate(samples.stamped.tolist()) if stamp in commands_by_stamp]
    assert len(common) >= 150
    assert all(tuple(commands[row]) == commands_by_stamp[int(samples.stamped[row])] for row in common)
    tracking_rows = np.flatnonzero(columns["mode"] == "TRACKING")
    assert len(tracking_rows) >= 145
    assert np.allclose(np.diff(columns["t_s"][tracking_rows]), DT, atol=1e-6)
    assert all(np.isfinite(columns[name][tracking_rows[2:]]).all() for name in ("v_wheel_m_s", "omega_gyro_rad_s"))
    assert np.isfinite(columns["estimate_x_sd_m"][tracking_rows]).all()
    assert all(log.plans[row] is not None for row in tracking_rows)
    assert counts[REFERENCE] == 1 and counts[PLAN] >= len(tracking_rows) and counts[DIAGNOSTICS] >= 1
    assert TRUE_POSE not in counts and ("/pose" in counts) == pose_topic
    assert log.metadata["case"]["trajectory"] == "circle" and "horizon" in log.metadata["configuration"]["yaml"]


def test_each_activation_writes_a_new_file(tmp_path):
    with stack(record=True, record_folder=str(tmp_path)) as s:
        s.base.run(5)
        s.node.trigger_deactivate()
        assert len(list(tmp_path.iterdir())) == 1
        s.node.trigger_activate()
        s.await_inputs()
        s.base.run(5)
    files = list(tmp_path.iterdir())
    assert len(files) == 2 and not any(read_drive_log(path).cut for path in files)


def test_unwritable_folder_gives_a_warning_without_stopping_the_robot(tmp_path, capfd):
    (tmp_path / "file").touch()
    with stack(drive=True, record=True, record_folder=str(tmp_path / "file")) as s:
        s.base.run(60)
        assert s.loop.last.command[0] > 0.1
        assert s.node.parts["recording"].recording.incomplete
    assert "recording has ended: " in capfd.readouterr().err
