"""Results from poses: wheel geometry and slip, gyro scale, and drift of predicted poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.base_effects import PoseMount
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.fit.pose_calibration import (
    ConstantTrack,
    PoseCalibration,
    calibrate_gyro,
    calibrate_wheels,
)
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate, join_estimates
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle

_HORIZON_TOLERANCE = 0.2
"""Maximum difference between the last pose of a prediction and the horizon, as a share of the horizon [-]."""
_LEVER_ARM = ("lever_arm_ahead", "lever_arm_left")
# Fictitious wheels for odometry without wheel speeds; their rates are computed from the twist.
_UNIT_WHEELS = WheelGeometry(1.0, 1.0)
Predictions = list[tuple[Record, FloatArray]]
"""Records with poses, each with the predicted twist (K, 2) of the body: v [m/s], omega [rad/s]."""


@dataclass(frozen=True)
class PoseDrift:
    """Pose error at one prediction horizon.

    Attributes
    ----------
    horizon
        Prediction horizon [s].
    position_rmse, heading_rmse
        Root mean square errors [m, rad].
    position_mean
        Mean position error [m].
    starts
        Number of predictions.
    """

    horizon: float
    position_rmse: float
    heading_rmse: float
    position_mean: float
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
    """Compute the open-loop pose error of the rotation centre.

    Predictions start at measured poses of a record, about one per second. A prediction integrates the predicted twists
    as arcs, and ends at the measured pose nearest to the horizon.

    Parameters
    ----------
    records
        Records with a pose.
    twists
        Predicted v [m/s] and true yaw rate [rad/s] (K, 2) of each record, from one free run over the record.
    lever_arm
        Position of the pose point relative to the rotation centre: ahead and to the left [m].
    side_slip
        Ratio of lateral speed and -v omega [s].
    pose_lag
        Age of the poses at their stamp [s].
    horizons
        Prediction horizons [s]; by default from the settings.

    Raises
    ------
    ValueError
        If a record has no poses, or if no record has two poses about one horizon apart.
    """
    settings = identification_settings()
    return [
        _drift_after(records, twists, horizon, lever_arm, side_slip, pose_lag, settings.start_every)
        for horizon in (horizons or settings.horizons)
    ]


def rotation_centre(pose: FloatArray, lever_arm: tuple[float, float]) -> FloatArray:
    """Convert poses (..., 3) of a point at `lever_arm` (ahead, left) [m] to poses of the rotation centre."""
    ahead, left = lever_arm
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack([pose[..., 0] - ahead * c + left * s, pose[..., 1] - ahead * s - left * c, pose[..., 2]], axis=-1)


def _drift_after(
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
            raise ValueError(f"record '{record.name}': the drift of a prediction requires poses")
        centre = rotation_centre(record.pose, lever_arm)
        lag, steps, stride = (round(time / record.dt) for time in (pose_lag, horizon, start_every))
        fresh_rows = lag + np.flatnonzero(record.fresh_pose[lag : len(twist)])
        if not len(fresh_rows):
            continue
        starts = np.unique(_nearest(fresh_rows, np.arange(lag, len(twist) - steps, stride)))
        ends = _nearest(fresh_rows, starts + steps)
        is_near = np.abs(ends - starts - steps) <= _HORIZON_TOLERANCE * steps
        starts, ends = starts[is_near], ends[is_near]
        mean = 0.5 * (twist[1:] + twist[:-1])
        pose = centre[starts]
        for step in range(max(ends - starts, default=0)):
            (is_active,) = np.nonzero(step < ends - starts)
            v, omega = mean[starts[is_active] - lag + step].T
            pose[is_active] = integrate_pose(pose[is_active], v, omega, record.dt, side_slip)
        error = pose - centre[ends]
        errors.append(np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(wrap_angle(error[:, 2]))]))
    magnitudes = np.concatenate([np.empty((0, 2)), *errors])
    if not len(magnitudes):
        raise ValueError(f"no two poses of a record are {horizon:.3g} s apart; use longer records, or more poses")
    rmse = np.sqrt((magnitudes**2).mean(axis=0))
    return PoseDrift(horizon, float(rmse[0]), float(rmse[1]), float(magnitudes[:, 0].mean()), len(magnitudes))


def _nearest(rows: NDArray[np.int64], targets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the nearest of the sorted `rows` (n,) for each of the `targets` (k,)."""
    following = np.searchsorted(rows, targets).clip(0, len(rows) - 1)
    preceding = rows[np.maximum(following - 1, 0)]
    return np.asarray(np.where(targets - preceding <= rows[following] - targets, preceding, rows[following]))


@dataclass(frozen=True)
class PoseResults:
    """Results of the calibration from poses.

    Attributes
    ----------
    parameters
        Parameters of wheels and gyro, SI units; empty if the log has no poses.
    drift
        Open-loop pose error on the validation records by horizon.
    warnings
        Doubts about the results.
    """

    parameters: ParameterEstimate
    drift: tuple[PoseDrift, ...]
    warnings: tuple[Doubt, ...]

    @property
    def mount(self) -> tuple[str, ...]:
        """Names of the two parameters of the pose point, ahead and left; empty if they are not estimated."""
        pairs = (_LEVER_ARM, ("mount.ahead", "mount.left"))
        return next((pair for pair in pairs if set(pair) <= set(self.parameters.names)), ())

    @property
    def place(self) -> tuple[float, float]:
        """Position of the pose point ahead and left of the rotation centre [m]; zeros if it is near or unknown."""
        if not self.mount:
            return (0.0, 0.0)
        ahead, left = (self.parameters.value(name) for name in self.mount)
        deviation, settings = max(self.parameters.deviation(name) for name in self.mount), identification_settings()
        # Rounded positions and wheel speeds leave the point uncertain by centimetres.
        minimum = max(settings.warn.lever_arm, settings.sensors.significance * deviation)
        return (ahead, left) if math.hypot(ahead, left) >= minimum else (0.0, 0.0)

    def at_rotation_centre(self, records: Sequence[Record]) -> list[Record]:
        """Return the records with poses, converted to poses of the rotation centre."""
        return [replace(r, pose=rotation_centre(np.asarray(r.pose), self.place)) for r in _select_with_pose(records)]


class PosePoint(NamedTuple):
    """Position, side-slip and delay of measured poses relative to the body's rotation centre."""

    lever_arm: tuple[float, float] = (0.0, 0.0)
    """Position of the pose point ahead and to the left [m]."""
    side_slip: float = 0.0
    """Ratio of lateral speed and -v omega [s]."""
    lag: float = 0.0
    """Delay of poses [s]."""


NO_POSES = PoseResults(ParameterEstimate((), np.empty(0), np.empty((0, 0))), (), ())


def from_poses(data: LogData, fitted: Fitted) -> PoseResults:
    """Calibrate on the training records with poses, and predict the poses of the validation records.

    Results for which there are too few poses are omitted with a warning.
    """
    train, validation = _select_with_pose(data.train), _select_with_pose(data.validation)
    if not train and not validation:
        return NO_POSES
    warnings: list[Doubt] = []
    wheels = _calibrate_wheels(train, fitted.geometry, warnings)
    if fitted.base and data.yaw == "gyro":
        pose_parameters = fitted.base.pose or NO_POSES.parameters
        return PoseResults(
            pose_parameters, _compute_drift(*_predict_with_base(data, fitted.base), warnings), tuple(warnings)
        )
    gyro = _calibrate_gyro(train, warnings) if data.yaw == "gyro" else None
    calibrations = [("wheels", wheels)] if wheels else []
    calibrations += [("gyro", gyro)] if gyro else []
    warnings += [doubt.about("poses") for _, calibration in calibrations for doubt in calibration.warnings]
    parts = [calibration.parameters for _, calibration in calibrations]
    if wheels and fitted.geometry is None:
        # Radius and track of unit wheels are ratios of the body's twist and the odometry's twist.
        names = ("longitudinal_gain", "yaw_gain", *parts[0].names[2:])
        parts[0] = parts[0].derived(names, lambda row: np.concatenate([[row[0], row[0] / row[1]], row[2:]]))
    parameters = join_estimates(parts) if parts else NO_POSES.parameters
    drift = _compute_drift(*_predict_with_model(data, fitted, wheels.parameters if wheels else None, gyro), warnings)
    return PoseResults(parameters, drift, tuple(warnings))


def _calibrate_wheels(
    train: Sequence[Record], geometry: WheelGeometry | None, warnings: list[Doubt]
) -> PoseCalibration | None:
    """Calibrate wheel radius, effective track and side-slip; without wheel speeds, those of unit wheels."""
    records = train if geometry else [_add_unit_wheels(record) for record in train]
    try:
        return calibrate_wheels(records, ConstantTrack(*(geometry or _UNIT_WHEELS))) if train else None
    except ValueError as error:
        warnings.append(Doubt("pose calibration", f"wheels are not calibrated from poses: {error}"))
        return None


def _calibrate_gyro(train: Sequence[Record], warnings: list[Doubt]) -> PoseCalibration | None:
    try:
        return calibrate_gyro(train) if train else None
    except ValueError as error:
        warnings.append(Doubt("pose calibration", f"the gyro is not calibrated from poses: {error}"))
        return None


def _predict_with_model(
    data: LogData, fitted: Fitted, wheels: ParameterEstimate | None, gyro: PoseCalibration | None
) -> tuple[Predictions, PosePoint]:
    """Predict the body's twist by the calibrated model; return predictions and pose point."""
    wheel_geometry = fitted.geometry or _UNIT_WHEELS
    gain = np.ones(2)
    if wheels:
        gain[0] = wheels.value("wheel_radius") / wheel_geometry.radius
        if data.yaw == "encoders":
            gain[1] = gain[0] * wheel_geometry.track / wheels.value("track")
    if gyro:
        gain[1] = 1.0 / gyro.parameters.value("gyro_scale")
    predictions = [
        (record, gain * (outputs - fitted.offset))
        for record, outputs in zip(data.validation, fitted.simulated, strict=True)
        if record.pose is not None
    ]
    if wheels is None:
        return predictions, PosePoint()
    lever_arm = (wheels.value(_LEVER_ARM[0]), wheels.value(_LEVER_ARM[1]))
    return predictions, PosePoint(lever_arm, wheels.value("side_slip"))


def _predict_with_base(data: LogData, base: IdentifiedBase) -> tuple[Predictions, PosePoint]:
    """Predict the twist by a model with base effects; return predictions for poses without mount, and pose point."""
    records = _select_with_pose(data.validation)
    predictions = list(zip(records, base.body_twists(records), strict=True))
    if base.pose is None:
        return predictions, PosePoint()
    mount = PoseMount(**{name: base.pose.value(f"mount.{name}") for name in ("ahead", "left", "heading")})
    corrected = [(replace(record, pose=mount.centre(np.asarray(record.pose))), twist) for record, twist in predictions]
    return corrected, PosePoint(lag=base.pose.value("pose.delay"))


def _compute_drift(predictions: Predictions, point: PosePoint, warnings: list[Doubt]) -> tuple[PoseDrift, ...]:
    records, twists = [record for record, _ in predictions], [twist for _, twist in predictions]
    drift: list[PoseDrift] = []
    for horizon in identification_settings().horizons:
        try:
            drift += pose_drift(
                records,
                twists,
                lever_arm=point.lever_arm,
                side_slip=point.side_slip,
                pose_lag=point.lag,
                horizons=[horizon],
            )
        except ValueError as error:
            warnings.append(Doubt("pose calibration", f"no pose error at {horizon:g} s: {error}"))
    return tuple(drift)


def _select_with_pose(records: Sequence[Record]) -> list[Record]:
    return [record for record in records if record.pose is not None]


def _add_unit_wheels(record: Record) -> Record:
    """Add the rates of fictitious wheels, with 1 m radius and 1 m track, that correspond to the record's twist."""
    if record.twist is None:
        return record
    v, omega = record.twist.T
    wheels: FloatArray = np.column_stack([v - omega / 2, v + omega / 2])
    return replace(record, wheels=wheels)
