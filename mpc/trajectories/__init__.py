"""Reference trajectories of a differential-drive robot, loaded by name or from files."""

from __future__ import annotations

from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN, load_segments, load_trajectory
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory

__all__ = ["BUILT_IN", "Trajectory", "TrajectoryLimits", "load_segments", "load_trajectory"]
