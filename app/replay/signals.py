"""Any CSV log with a mapping: its columns as the ticks that a controller would have had."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.recording import RecordedTick, Recording
from diffdrive_mpc.app.replay.settings import replay_settings
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.csv_log import read_csv
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.logs.sampling import RawStretch, Signal
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.mpc import ControllerConfig, Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS

# The reference as a log holds it: its samples at the ticks, and cubics between them.


_POSE = ("reference_x_m", "reference_y_m", "reference_theta_rad")
_TWIST = ("reference_v_m_s", "reference_omega_rad_s")

_SAME = 1e-9
"""Two references that agree to this at every tick are one [m, rad, m/s, rad/s]."""


def logged_reference(
    columns: Mapping[str, FloatArray], name: str, config: ControllerConfig | None = None
) -> Trajectory | None:
    """What was tracked at each tick as a trajectory whose time 0 is the first tick; None where it is not in the log.

    Where it is one that ships, within the limits of `config` or the usual ones, that one is taken. Of another it is the
    reference itself at the ticks, so a controller that is on time sees what the recorded one saw; it ends at the first
    tick from which on the reference rests.
    """
    if not set(_POSE + _TWIST) <= set(columns) or len(columns["t_s"]) < 2:
        return None
    pose, twist = (np.column_stack([columns[one] for one in names]) for names in (_POSE, _TWIST))
    time = columns["t_s"] - columns["t_s"][0]
    if not (np.isfinite(pose).all() and np.isfinite(twist).all() and (np.diff(time) > 0).all()):
        return None
    return shipped(pose, twist, time, config) or hermite(name, time, pose, twist)


def shipped(
    pose: FloatArray, twist: FloatArray, time: FloatArray, config: ControllerConfig | None = None
) -> Trajectory | None:
    """The trajectory that ships with these poses (m, 3) and twists (m, 2) at `time` (m,) [s]; None without one."""
    usual = TrajectoryLimits.of_robot()
    own = usual if config is None else TrajectoryLimits.of_controller(config.limits)
    for limits in dict.fromkeys((own, usual)):
        for name, timing in itertools.product(BUILT_IN, (None, *TIMINGS)):
            try:
                trajectory = load_trajectory(name, limits, timing)
            except BeyondLimitError:
                continue
            if np.abs(trajectory.sample(time[:1]).pose - pose[:1]).max() > _SAME:
                continue
            sample = trajectory.sample(time)
            if np.abs(sample.pose - pose).max() < _SAME and np.abs(sample.twist - twist).max() < _SAME:
                return trajectory
    return None


def hermite(name: str, time: FloatArray, pose: FloatArray, twist: FloatArray) -> SplineTrajectory:
    """Cubics through poses (m, 3) with twists (m, 2) at `time` (m,) [s] from 0, up to where they rest for good."""
    moving = np.flatnonzero((twist != 0.0).any(axis=1) | (np.diff(pose, axis=0, append=pose[-1:]) != 0.0).any(axis=1))
    end = max(2, min(len(time), int(moving[-1]) + 2 if len(moving) else 2))
    time, pose, twist = time[:end], pose[:end], twist[:end]
    rates = np.column_stack([twist[:, 0] * np.cos(pose[:, 2]), twist[:, 0] * np.sin(pose[:, 2]), twist[:, 1]])
    return SplineTrajectory.through(name, time, pose, rates)


# Poses for a log without any: dead reckoning by wheels and gyro. It drifts, and cannot tell the place.


STAND_IN = (
    "Poses are a stand-in: dead reckoning by wheels and gyro from (0, 0, 0). It drifts and cannot show side-slip, so "
    "errors of position and what the estimator says of poses mean nothing; dead time, limits and speeds do."
)


def by_odometry(readings: Mapping[str, Readings], log: str) -> Readings:
    """Poses at the readings of the wheels, turned by the gyro where there is one; raises ConfigError without wheels."""
    wheels, gyro = readings.get("wheel_twist"), readings.get("yaw_rate")
    if wheels is None or len(wheels.stamp) < 2:
        raise ConfigError(f"{log}: --pose odometry needs wheel speeds, and the log has none; map them")
    v, omega = wheels.value.T
    if gyro is not None:
        omega = np.interp(wheels.stamp, gyro.stamp, gyro.value[:, 0])
    steps = np.diff(wheels.stamp)
    pose = np.zeros((len(wheels.stamp), 3))
    for k, dt in enumerate(steps):
        pose[k + 1] = integrate_pose(pose[k], 0.5 * (v[k] + v[k + 1]), 0.5 * (omega[k] + omega[k + 1]), dt)
    return Readings(wheels.arrival, wheels.stamp, pose)


_FIELDS = {"pose": "pose", "twist": "wheel_twist", "yaw_rate": "yaw_rate"}
_COLUMNS = {"pose": "pose", "twist": "encoders", "yaw_rate": "gyro"}
FOREIGN = (
    "The log does not say when its readings reached the controller: each counts as there at the first tick after it "
    "was logged. A tick more or less shifts what is believed by up to one sample of motion."
)
_LEAST_TICKS = 10


def read_mapped_csv(path: Path, mapping: LogMapping, sample_time: float, *, stand_in: bool) -> Recording:
    """Read a CSV log.

    Parameters
    ----------
    path, mapping
        The file, and what its columns are.
    sample_time
        Of the controller [s].
    stand_in
        Whether dead reckoning by wheels and gyro takes the place of poses.

    Raises ConfigError if the file or a column cannot be used, or no stretch of it is long enough.
    """
    raw = read_csv(path, mapping)
    ticks: list[RecordedTick] = []
    approximated: list[str] = [FOREIGN]
    left_out = 0
    for stretch in raw.stretches:
        signals, words = _stretch(stretch, mapping, sample_time, path.name, stand_in=stand_in)
        if len(signals) < _LEAST_TICKS:
            left_out += 1
            continue
        ticks += signals
        approximated += [word for word in words if word not in approximated]
    if not ticks:
        raise ConfigError(f"{path}: no stretch of {_LEAST_TICKS} ticks of {sample_time:g} s; record for longer")
    findings = [str(finding) for finding in raw.findings]
    if left_out:
        findings.append(f"{path.name}: {left_out} stretches are shorter than {_LEAST_TICKS} ticks and are left out")
    return Recording(
        path.name,
        "CSV log of another recorder",
        tuple(ticks),
        by_controller=False,
        approximated=tuple(approximated),
        findings=tuple(findings),
    )


def _stretch(
    stretch: RawStretch, mapping: LogMapping, sample_time: float, name: str, *, stand_in: bool
) -> tuple[list[RecordedTick], list[str]]:
    assert mapping.columns is not None
    time, command, words = on_grid(stretch.command.time, stretch.command.value, sample_time, name)
    readings = {}
    for field, signal in stretch.measured.items():
        if field in _FIELDS and len(signal.time):
            readings[_FIELDS[field]] = _readings(signal, getattr(mapping.columns, _COLUMNS[field]).delay)
    notes = list(words)
    if stand_in:
        readings["pose"] = by_odometry(readings, name)
    return assembled(time, command, readings), notes


def _readings(signal: Signal, delay: float) -> Readings:
    """Those of a signal whose readings appear in the log `delay` [s] after the fact."""
    return Readings(np.asarray(signal.time + delay), signal.time, signal.value)


# The path that the robot drove as a reference: smoothed, and timed as it was driven.


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
