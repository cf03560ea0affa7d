"""How far a pose predicted from commands alone is from the measured one, some time after the two agreed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle


@dataclass(frozen=True)
class PoseDrift:
    """Error after one horizon.

    Attributes
    ----------
    horizon
        [s].
    position_rmse, heading_rmse
        [m], [rad].
    position_mean, heading_mean
        Mean size of the error [m], [rad].
    starts
        How many predictions it is taken over.
    """

    horizon: float
    position_rmse: float
    heading_rmse: float
    position_mean: float
    heading_mean: float
    starts: int


def pose_drift(
    records: Sequence[Record],
    twists: Sequence[FloatArray],
    *,
    lever_arm: tuple[float, float] = (0.0, 0.0),
    side_slip: float = 0.0,
    pose_lag: float = 0.0,
    horizons: Sequence[float] | None = None,
) -> list[PoseDrift]:
    """Open-loop pose error about the rotation centre.

    A prediction starts at the measured pose every second inside one record, and follows the arcs of the predicted
    twists; position errors are those of the point that the robot turns about.

    Parameters
    ----------
    records
        Records with a pose.
    twists
        For each record (K, 2) predicted v [m/s] and true yaw rate [rad/s], from one free run over the whole record.
    lever_arm
        Pose point seen from the rotation centre: ahead and to the left [m].
    side_slip
        Lateral speed over -v omega [s].
    pose_lag
        By how much poses describe the robot earlier than their stamp says [s].
    horizons
        [s]; those of the settings by default.

    Raises
    ------
    ValueError
        If a record has no pose, or none is as long as the horizon.
    """
    settings = identification_settings()
    return [
        _drift(records, twists, horizon, lever_arm, side_slip, pose_lag, settings.start_every)
        for horizon in (horizons or settings.horizons)
    ]


def rotation_centre(pose: FloatArray, lever_arm: tuple[float, float]) -> FloatArray:
    """Poses (..., 3) of the rotation centre from those of a point `lever_arm` ahead and to the left of it [m]."""
    ahead, left = lever_arm
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack([pose[..., 0] - ahead * c + left * s, pose[..., 1] - ahead * s - left * c, pose[..., 2]], axis=-1)


def _drift(
    records: Sequence[Record],
    twists: Sequence[FloatArray],
    horizon: float,
    lever_arm: tuple[float, float],
    side_slip: float,
    pose_lag: float,
    start_every: float,
) -> PoseDrift:
    errors = []
    for record, twist in zip(records, twists, strict=True):
        if record.pose is None or record.fresh_pose is None:
            raise ValueError(f"record '{record.name}': no pose; the drift of a prediction needs one")
        centre = rotation_centre(record.pose, lever_arm)
        lag, steps, stride = (round(time / record.dt) for time in (pose_lag, horizon, start_every))
        starts = np.arange(lag, len(twist) - steps, stride)
        starts = starts[record.fresh_pose[starts] & record.fresh_pose[starts + steps]]
        if not len(starts):
            continue
        mean = 0.5 * (twist[1:] + twist[:-1])
        pose = centre[starts]
        for step in range(steps):
            v, omega = mean[starts - lag + step].T
            pose = integrate_pose(pose, v, omega, record.dt, side_slip)
        error = pose - centre[starts + steps]
        errors.append(np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(wrap_angle(error[:, 2]))]))
    if not errors:
        raise ValueError(f"no record is {horizon:.3g} s long with poses at both ends; give longer ones")
    size = np.concatenate(errors)
    rmse = np.sqrt((size**2).mean(axis=0))
    mean_size = size.mean(axis=0)
    return PoseDrift(horizon, float(rmse[0]), float(rmse[1]), float(mean_size[0]), float(mean_size[1]), len(size))
