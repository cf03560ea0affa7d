"""The reference as a log holds it: its samples at the ticks, and cubics between them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import ControllerConfig, Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS

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
                found = load_trajectory(name, limits, timing)
            except BeyondLimitError:
                continue
            if np.abs(found.sample(time[:1]).pose - pose[:1]).max() > _SAME:
                continue
            sample = found.sample(time)
            if np.abs(sample.pose - pose).max() < _SAME and np.abs(sample.twist - twist).max() < _SAME:
                return found
    return None


def hermite(name: str, time: FloatArray, pose: FloatArray, twist: FloatArray) -> SplineTrajectory:
    """Cubics through poses (m, 3) with twists (m, 2) at `time` (m,) [s] from 0, up to where they rest for good."""
    moving = np.flatnonzero((twist != 0.0).any(axis=1) | (np.diff(pose, axis=0, append=pose[-1:]) != 0.0).any(axis=1))
    end = max(2, min(len(time), int(moving[-1]) + 2 if len(moving) else 2))
    time, pose, twist = time[:end], pose[:end], twist[:end]
    rates = np.column_stack([twist[:, 0] * np.cos(pose[:, 2]), twist[:, 0] * np.sin(pose[:, 2]), twist[:, 1]])
    return SplineTrajectory.through(name, time, pose, rates)
