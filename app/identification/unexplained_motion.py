"""Motion of a robot in the data held out beyond its model, in blocks that trial drives add to the motion of a plant."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.app.identification.trial_drives import log_slip, trial_settings
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.logs.record import Record

_FEWEST_POSES = 4


def unexplained_motion(identification: Identification) -> list[FloatArray]:
    """Return, for each record held out, twists measured less predicted, means over windows (K, 3).

    Forward and lateral speed [m/s] and yaw rate [rad/s] of the rotation centre on the surface of the log. Measured is
    by the poses where the record has them, else by encoders and gyro, which see no lateral speed.
    """
    report = identification.report
    slip = log_slip(identification)
    motion = []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        assert record.twist is not None
        yaw_rate = record.yaw_rate if report.data.yaw == "gyro" else None
        rows = np.column_stack([record.twist[:, 0], np.zeros(len(outputs)), record.twist[:, 1]])
        rows[:, 2] = rows[:, 2] if yaw_rate is None else yaw_rate
        rows[:, [0, 2]] -= outputs
        steps = max(1, round(trial_settings().window / record.dt))
        rows = _means(np.nan_to_num(rows), np.arange(0, len(rows) + 1, steps))
        if record.pose is not None:
            predicted = slip.body((outputs - report.fitted.offset).T).T
            turning = predicted[:, 2] if yaw_rate is None else np.nan_to_num(yaw_rate - report.fitted.offset[1])
            by_poses = _by_poses(report.poses.centred([record])[0], predicted, turning)
            if by_poses is not None:
                rows = np.column_stack([by_poses[:, :2], (by_poses if yaw_rate is None else rows)[:, 2]])
        motion.append(rows)
    return motion


def drawn_motion(
    motion: Sequence[FloatArray], duration: float, rate: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Return twists (K, 3) of blocks of the motion, drawn with equal probability.

    Parameters
    ----------
    motion
        By `unexplained_motion`.
    duration
        Duration of the returned motion [s].
    rate
        Sample times of the given and of the returned motion [s].
    rng
        Random generator.
    """
    measured, dt = rate
    block = round(identification_settings().block_time / measured)
    begins = [(i, first) for i, rows in enumerate(motion) for first in range(max(1, len(rows) - block + 1))]
    parts: list[FloatArray] = []
    while sum(map(len, parts)) * measured < duration:
        i, first = begins[rng.integers(len(begins))]
        parts.append(motion[i][first : first + block])
    return np.asarray(np.concatenate(parts)[(np.arange(round(duration / dt)) * dt / measured).astype(int)])


def _means(rows: FloatArray, ends: AnyArray) -> FloatArray:
    """Replace rows (K, n) by their means between `ends`; the motion outside of them is zero."""
    means = np.zeros_like(rows)
    for first, stop in itertools.pairwise(ends):
        means[first:stop] = rows[first:stop].mean(axis=0)
    return means


def _by_poses(record: Record, predicted: FloatArray, turning: FloatArray) -> FloatArray | None:
    """Return displacements between poses less those of predicted twists (K, 3), over their time (K, 3); None if few.

    The heading is the integral of `turning` (K,) [rad/s], laid over the poses of a window: less noise than a pose's.
    Windows are so long that the noise of the poses has little effect, and its part of the power is subtracted.
    """
    assert record.pose is not None and record.fresh_pose is not None
    dt, fresh = record.dt, record.fresh_pose
    if np.count_nonzero(fresh) < _FEWEST_POSES:
        return None
    turned = dt * np.cumsum(turning)
    half = round(identification_settings().pose_window / dt)
    off = np.where(fresh, record.pose[:, 2] - turned, 0.0)
    window = np.ones(2 * half + 1)
    heading = turned + np.convolve(off, window, "same") / np.maximum(np.convolve(fresh, window, "same"), 1.0)
    path = dt * np.cumsum((predicted[:, 0] + 1j * predicted[:, 1]) * np.exp(1j * heading))
    beyond = record.pose[:, 0] + 1j * record.pose[:, 1] - path
    turn = record.pose[:, 2] - dt * np.cumsum(predicted[:, 2])
    # Smooth motion has no second differences between consecutive poses.
    noise = np.array([np.mean(np.abs(np.diff(rows[fresh], 2)) ** 2) / 6.0 for rows in (beyond, turn)])
    noise[0] /= 2.0
    steps = max(half, round(math.sqrt(2.0 * noise[0]) / trial_settings().noise_speed / dt), 1)
    ends: list[int] = []
    for k in np.flatnonzero(fresh):
        if not ends or k - ends[-1] >= steps:
            ends.append(int(k))
    if len(ends) < _FEWEST_POSES:
        return None
    first, last = np.array(ends[:-1]), np.array(ends[1:])
    moved = np.diff(beyond[ends]) * np.exp(-1j * heading[(first + last) // 2])
    windows = np.column_stack([moved.real, moved.imag, np.diff(turn[ends])])
    power = np.maximum((windows**2).mean(axis=0), np.finfo(float).tiny)
    windows *= np.sqrt(np.maximum(1.0 - 2.0 * noise[[0, 0, 1]] / power, 0.0))
    rows = np.zeros((len(fresh), 3))
    rows[ends[0] : ends[-1]] = np.repeat(windows / (dt * (last - first))[:, None], last - first, axis=0)
    return rows
