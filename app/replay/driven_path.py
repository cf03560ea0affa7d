"""The path that the robot drove as a reference: smoothed, and timed as it was driven."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.settings import replay_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

DRIVEN = (
    "The reference is the driven path itself, smoothed and timed as it was driven: given where the robot went, what "
    "would this controller have commanded to go there?"
)


def driven_paths(recording: Recording) -> tuple[SplineTrajectory, ...]:
    """One for each start; raises ConfigError where the log has no poses to make one of."""
    ticks = recording.ticks
    begins = [number for number, tick in enumerate(ticks) if tick.start is not None]
    paths = []
    for first, stop in pairwise([*begins, len(ticks)]):
        poses = [tick.measurement.pose for tick in ticks[first:stop]]
        came = [pose for pose in poses if pose is not None]
        rows = np.array([[pose.time, *np.asarray(pose.value, dtype=float)] for pose in came]).reshape(-1, 4)
        start = ticks[first].start
        assert start is not None
        paths.append(_path(recording.name, rows, start.t0, ticks[stop - 1].time))
    return tuple(paths)


def _path(log: str, rows: FloatArray, begin: float, end: float) -> SplineTrajectory:
    """Through poses t, x, y, theta (m, 4), from `begin` to `end` [s]; forward motion only is what a reference has."""
    settings = replay_settings()
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.concatenate([[True], np.diff(rows[:, 0]) > 0])] if len(rows) else rows
    if len(rows) < 2:
        raise ConfigError(
            f"{log}: no poses, so there is no path to track; give --trajectory, or --pose odometry to let dead "
            "reckoning stand in for poses"
        )
    count = max(2, int((end - begin) / settings.grid) + 1)
    time = np.linspace(0.0, max(end - begin, settings.grid), count)
    values = np.column_stack([rows[:, 1:3], np.unwrap(rows[:, 3])])
    pose = np.column_stack([np.interp(begin + time, rows[:, 0], column) for column in values.T])
    pose = gaussian_filter1d(pose, settings.smoothing / (time[1] - time[0]), axis=0, mode="nearest")
    return SplineTrajectory.through(f"{log}: driven path", time, pose, np.gradient(pose, time, axis=0))
