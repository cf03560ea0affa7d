"""Recordings of the node over DDS, in real time and in lock step, replay to the last bit."""

from contextlib import suppress

import numpy as np
import pytest
from two_processes import drive_over_dds

from commands import invoke
from diffdrive_mpc import ConfigError
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.replay.node_log import LoggedConfigs
from diffdrive_mpc.app.replay.own_log import read_recording
from diffdrive_mpc.app.replay.replay import replay
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build

CASE = Case(trajectory="cane", sensors="slam", overrides=(("weights.across", 90.0),))


@pytest.mark.parametrize("lock_step", [True, False])
def test_mcap_bag_of_the_node_replays_to_the_last_bit(lock_step, tmp_path):
    _, _, reference = build(CASE)
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        drive_over_dds(CASE, reference.duration, folder, lock_step=lock_step, timeout=120.0)
        (bag,) = folder.glob("*.mcap")
        # In real time the node may start late, or before the robot has discovered the topics that it records.
        with suppress(ConfigError):
            recording = read_recording(bag, LoggedConfigs(bag, tmp_path))
            if not recording.notes and len(recording.ticks) > 300:
                break
    assert recording.config.weights.across == 90.0 and not recording.notes
    assert len(recording.ticks) > 300
    replayed = replay(recording, recording.config, recording.references, as_recorded=True)
    assert np.array_equal(replayed.command, recording.command)
    assert replayed.modes == tuple(tick.mode for tick in recording.ticks)
    assert "commands are equal at every tick" in " ".join(invoke(app, "log", "replay", bag).stdout.split())
