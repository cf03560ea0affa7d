"""Sensors that stopped reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.checks.responses import largest_command
from diffdrive_mpc.models.logs.checks.settings import CheckSettings
from diffdrive_mpc.models.logs.record import BoolArray, Finding, Record

_SENSORS = {
    "encoders": ("twist", "fresh_twist", (0, 1)),
    "gyro": ("yaw_rate", "fresh_yaw_rate", (1,)),
    "pose": ("pose", "fresh_pose", (0, 1)),
}
"""Field, mask, and the channels of the command that the sensor should answer to."""


def check_sensors(records: Sequence[Record], settings: CheckSettings) -> tuple[list[Record], list[Finding]]:
    """Find readings that stay the same bit for bit although the command says otherwise, and mark them as not fresh.

    A reading is stuck if the command changed and, `stuck_time` later, it still had not; or if a robot that should
    move reads zero, or one and the same pose, for `stuck_time`. A robot that was held (an emergency stop, a blocked
    wheel) looks the same, and is no less useless for a model.
    """
    largest = largest_command(records)
    checked, findings = [], []
    for record in records:
        changes: dict[str, BoolArray] = {}
        for sensor, (field, mask, channels) in _SENSORS.items():
            values, fresh = getattr(record, field), getattr(record, mask)
            if values is None:
                continue
            asked = np.divide(record.command, largest, out=np.zeros_like(record.command), where=largest > 0)
            for first, last in _stuck(values, fresh, asked[:, channels], sensor == "pose", record.dt, settings):
                changes.setdefault(mask, fresh.copy())[first + 1 : last + 1] = False
                start, end = float(record.time[first]), float(record.time[last])
                words = f"the {sensor} read the same for {end - start:.1f} s while the robot should move; left out"
                place = f"{record.name.split(',')[0]}, {start:.1f} to {end:.1f} s"
                findings.append(Finding("stuck sensor", "warning", place, words, (start, end)))
        checked.append(replace(record, **changes))  # type: ignore[arg-type]  # masks only
    return checked, findings


def _stuck(
    values: FloatArray, fresh: BoolArray, asked: FloatArray, is_pose: bool, dt: float, settings: CheckSettings
) -> list[tuple[int, int]]:
    """First and last sample of each run of equal readings that the commands, as shares of the largest, contradict."""
    samples = np.flatnonzero(fresh)
    if not len(samples):
        return []
    readings = values[samples].reshape(len(samples), -1)
    edges = np.flatnonzero((np.diff(readings, axis=0) != 0).any(axis=1))
    patience = int(np.ceil(settings.stuck_time / dt))
    runs = []
    for a, b in zip([0, *(edges + 1)], [*edges, len(samples) - 1], strict=True):
        first, last = int(samples[a]), int(samples[b])
        if last - first < patience:
            continue
        commands = asked[first : last - patience + 1]
        at_rest = is_pose or not readings[a].any()
        moving = (np.abs(asked[first : last + 1]) > settings.stuck_command).any(axis=1).all()
        changed = np.ptp(commands, axis=0).max() > settings.stuck_command
        if changed or (at_rest and moving):
            runs.append((first, last))
    return runs
