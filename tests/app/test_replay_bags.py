"""Bags of the node and the simulated robot over DDS: replayed to the bit, from what is in the bag alone."""

import json
import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from two_processes import drive_over_dds

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.replay.open_loop import replay
from diffdrive_mpc.app.replay.reading import read_recording
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build

DT = 0.0202
CASE = Case(trajectory="cane", sensors="slam", overrides=(("weights.across", 90.0),))


@pytest.fixture(scope="module", params=[True, False], ids=["lock step", "real time"])
def bag(request, tmp_path_factory):
    """A drive along a path, and whether it was in lock step."""
    _, _, reference = build(CASE)
    for _ in range(3):
        folder = tmp_path_factory.mktemp("bags") / "drive"
        drive_over_dds(CASE, reference.duration, folder, lock_step=request.param, timeout=120.0)
        # In real time the drive may begin before the robot has heard of the topics that it records.
        if not read_recording(folder, None, DT, folder.parent).approximated:
            break
    return folder, request.param


def without(bag, folder, topics):
    """The bag without some topics."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader, Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        made = {}
        for connection, stamp, data in reader.messages():
            name = connection.topic
            if name in topics:
                continue
            if name not in made:
                made[name] = writer.add_connection(name, connection.msgtype, typestore=store)
            writer.write(made[name], stamp, data)
    return folder


def test_what_the_node_says_of_each_tick_makes_the_replay_exact(bag, tmp_path):
    """Configuration and reference come with the bag; in real time, too."""
    folder, _ = bag
    recording = read_recording(folder, None, DT, tmp_path)
    assert recording.config.weights.across == 90.0 and not recording.approximated
    assert len(recording.ticks) > 300
    again = replay(recording, recording.config, recording.references, as_recorded=True)
    assert np.array_equal(again.command, recording.command)
    assert again.modes == tuple(tick.mode for tick in recording.ticks)
    invoke(app, "replay", folder, "--out", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "replay.json").read_text())["commands"][0]["differing"] == 0


def test_commands_and_sensors_alone_are_exact_in_lock_step_and_near_in_real_time(bag, tmp_path):
    folder, in_lock_step = bag
    plain = without(folder, tmp_path / "plain", ("/diffdrive_mpc/tick", "/diffdrive_mpc/drive"))
    controller, _, reference = build(CASE)
    recording = read_recording(plain, None, DT, tmp_path)
    assert "does not say what its controller had received" in recording.approximated[0]
    again = replay(recording, controller.config, (reference,), as_recorded=False)
    apart = np.abs(again.command - recording.command)
    if in_lock_step:
        assert apart.max() < 1e-9
    else:
        assert np.median(apart) < 0.01


def test_a_bag_that_lacks_ticks_or_the_start_says_so(bag, tmp_path):
    folder, _ = bag
    no_drive = without(folder, tmp_path / "no_drive", ("/diffdrive_mpc/drive",))
    recording = read_recording(no_drive, None, DT, tmp_path)
    assert "record the topic ~/drive as well" in recording.approximated[0] and recording.config is None
    store = get_typestore(Stores.ROS2_JAZZY)
    with (
        Reader(folder) as reader,
        Writer(tmp_path / "holes", version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        made = {}
        for number, (connection, stamp, data) in enumerate(reader.messages()):
            name = connection.topic
            if name not in made:
                made[name] = writer.add_connection(name, connection.msgtype, typestore=store)
            if name != "/diffdrive_mpc/tick" or number % 7:
                writer.write(made[name], stamp, data)
    holes = read_recording(tmp_path / "holes", None, DT, tmp_path)
    assert any("ticks are missing from the bag" in words for words in holes.approximated)
    shutil.rmtree(tmp_path / "holes")
