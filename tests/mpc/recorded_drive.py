"""Conversion of a bag of the simulated robot to a run, and the number of missed samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.logs.bag_topics import (
    COMMANDS,
    POSES,
    Reading,
    TopicRequest,
    TopicRows,
    open_bag,
    read_topics,
)
from diffdrive_mpc.models.logs.mapping import Topic
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE

# Period between commands above which a sample lacks a new command, as a multiple of the sample time.
_MISSED = 1.5


def read_drive(bag: Path, reference: Reference, sample_time: float) -> Run:
    """Return the part of a recorded drive in which `reference` was tracked.

    The reference starts at the first nonzero command. The bag does not contain step times (NaN in the run), modes and
    measurements (empty in the run).

    Parameters
    ----------
    bag
        Folder that `diffdrive-mpc sim-robot --record` wrote.
    reference
        Tracked reference in the frame map.
    sample_time
        Sample time of the control loop [s].

    Raises
    ------
    ConfigError
        If the bag cannot be read.
    """
    with open_bag(bag) as reader:
        twist = {"geometry_msgs/msg/TwistStamped": _body_twist}
        requests = {
            "poses": TopicRequest(Topic(topic="/ground_truth/pose"), POSES),
            "twists": TopicRequest(Topic(topic="/ground_truth/twist"), twist),
            "commands": TopicRequest(Topic(topic="/cmd_vel"), COMMANDS),
        }
        poses, twists, commands = read_topics(reader, bag, requests).values()
    moving = np.flatnonzero(commands.value.any(axis=1))
    assert moving.size, f"{bag}: every command is zero"
    start = int(command_times(commands)[moving[0]])
    # The times are those of the plant, starting at the tick with the first command.
    first = int(np.searchsorted(poses.stamped, start, side="right")) - 1
    time = 1e-9 * (poses.stamped[first:] - poses.stamped[first])
    count = int(np.ceil((reference.duration - TIME_TOLERANCE) / sample_time)) + 1
    assert time[count - 1] >= reference.duration - TIME_TOLERANCE, f"{bag} ends early"
    rows = slice(first, first + count)
    time = time[:count]
    expected = reference.sample(time)
    true_pose = poses.value[rows].copy()
    true_pose[:, 2] = np.unwrap(true_pose[:, 2])
    return Run(
        reference=reference,
        sample_time=sample_time,
        time=time,
        true_pose=true_pose,
        true_twist=twists.value[rows],
        reference_pose=expected.pose,
        reference_twist=expected.twist,
        reference_arc_length=expected.arc_length,
        command=_commands_at(commands, poses.stamped[rows]),
        step_time=np.full(count, np.nan),
        modes=("",) * count,
        messages=("",) * count,
        measurements=(),
    )


def command_times(commands: TopicRows) -> FloatArray:
    """Return the times (n,) of the commands [ns]: their stamps, or the times of receipt without stamps."""
    return np.asarray(commands.stamped if commands.has_stamps else commands.received)


def _commands_at(commands: TopicRows, ticks: FloatArray) -> FloatArray:
    """Return the newest command (n, 2) at each of `ticks` (n,) [ns]."""
    newest = np.searchsorted(command_times(commands), ticks, side="right") - 1
    return np.where(newest[:, None] >= 0, commands.value[newest], 0.0)


def _body_twist(message: Any) -> Reading:
    twist = message.twist
    return float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)


def missed_samples(bag: Path, sample_time: float) -> int:
    """Return the number of periods between commands that are longer than one and a half sample times."""
    with open_bag(bag) as reader:
        requests = {"commands": TopicRequest(Topic(topic="/cmd_vel"), COMMANDS)}
        (commands,) = read_topics(reader, bag, requests).values()
    return int(np.count_nonzero(1e-9 * np.diff(command_times(commands)) > _MISSED * sample_time))
