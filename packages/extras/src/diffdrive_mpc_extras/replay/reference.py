"""Reference of a recorded drive, from its table or from its samples at the ticks."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.mpc import ControllerConfig, Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN
from diffdrive_mpc.mpc.trajectories.native import NativeTrajectory
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS

_POSE = ("reference_x_m", "reference_y_m", "reference_theta_rad")
_TWIST = ("reference_v_m_s", "reference_omega_rad_s")
_TOLERANCE = 1e-9
"""Maximum difference of two equal references at any tick [m, rad, m/s, rad/s]."""


@dataclass(frozen=True, eq=False, repr=False)
class TabledTrajectory(Trajectory):
    """Trajectory from a table.

    Attributes
    ----------
    native
        Table in the compiled core.
    """

    native: NativeTrajectory

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> TabledTrajectory:
        """Return the trajectory of a result of `table_of`; raises ConfigError for other data."""
        try:
            breaks, table = (np.array(data[name], dtype=float) for name in ("breaks", "table"))
            native = NativeTrajectory(breaks, table, float(data["duration"]), data["motion"])
            return cls(str(data["name"]), float(data["duration"]), native)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"the recorded reference cannot be read ({error})") from error

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; see `Trajectory.sample`."""
        return self.native.sample(times)


def logged_reference(
    columns: Mapping[str, FloatArray], name: str, config: ControllerConfig | None = None
) -> Trajectory | None:
    """Return the tracked reference with time 0 at the first tick; None if the log does not contain it.

    The columns are compared with the shipped trajectories, within the limits of `config` and the default limits. Other
    references are exact at the ticks and interpolated between them; they end at the start of their final rest.
    """
    if not set(_POSE + _TWIST) <= set(columns) or len(columns["t_s"]) < 2:
        return None
    pose, twist = (np.column_stack([columns[column] for column in names]) for names in (_POSE, _TWIST))
    time = columns["t_s"] - columns["t_s"][0]
    if not (np.isfinite(pose).all() and np.isfinite(twist).all() and (np.diff(time) > 0).all()):
        return None
    return _find_shipped(pose, twist, time, config) or _interpolate(name, time, pose, twist)


def _find_shipped(
    pose: FloatArray, twist: FloatArray, time: FloatArray, config: ControllerConfig | None
) -> Trajectory | None:
    """Find the shipped trajectory with these poses (m, 3) and twists (m, 2) at `time` (m,) [s]."""
    candidate_limits = (TrajectoryLimits.of_robot(), *(() if config is None else (config,)))[::-1]
    for limits, name, timing in itertools.product(candidate_limits, BUILT_IN, (None, *TIMINGS)):
        try:
            trajectory = load_trajectory(name, limits, timing)
        except BeyondLimitError:
            continue
        if np.abs(trajectory.sample(time[:1]).pose - pose[:1]).max() > _TOLERANCE:
            continue
        sample = trajectory.sample(time)
        if max(np.abs(sample.pose - pose).max(), np.abs(sample.twist - twist).max()) < _TOLERANCE:
            return trajectory
    return None


def _interpolate(name: str, time: FloatArray, pose: FloatArray, twist: FloatArray) -> SplineTrajectory:
    """Interpolate poses (m, 3) with twists (m, 2) at `time` (m,) [s] by cubic splines, up to the final rest."""
    moving = np.flatnonzero((twist != 0.0).any(axis=1) | (np.diff(pose, axis=0, append=pose[-1:]) != 0.0).any(axis=1))
    end = max(2, min(len(time), int(moving[-1]) + 2 if len(moving) else 2))
    time, pose, twist = time[:end], pose[:end], twist[:end]
    rates = np.column_stack([twist[:, 0] * np.cos(pose[:, 2]), twist[:, 0] * np.sin(pose[:, 2]), twist[:, 1]])
    return SplineTrajectory.through(name, time, pose, rates)
