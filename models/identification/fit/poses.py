"""Results from poses: geometry and slip of the wheels, scale of the gyro, and the drift of a predicted pose."""

from __future__ import annotations

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
    GrowingTrack,
    PoseCalibration,
    SlipLaw,
    SlipPolynomial,
    calibrate_gyro,
    calibrate_wheels,
)
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate, joined
from diffdrive_mpc.models.pose import integrate_pose, wrap_angle

_NEAR = 0.2
"""Part of the horizon by which the last pose of a prediction may be off it."""
_LEVER_ARM = ("lever_arm_ahead", "lever_arm_left")
# Wheels that an odometry without wheel speeds might have had: its twist is theirs by definition.
_UNIT_WHEELS = WheelGeometry(1.0, 1.0)
Predictions = list[tuple[Record, FloatArray]]
"""Records with a pose, each with the body's twist (K, 2) v [m/s], omega [rad/s] as predicted from the commands."""


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
        Number of predictions of the mean.
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
    """Compute the open-loop pose error about the rotation centre.

    A prediction starts at a measured pose about every second inside one record, follows the arcs of the predicted
    twists, and ends at the pose nearest to the horizon; position errors are those of the point that the robot turns
    about.

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
        Time by which the poses are older than their stamp states [s].
    horizons
        [s]; those of the settings by default.

    Raises
    ------
    ValueError
        If a record has no pose, or none has two poses about a horizon apart.
    """
    settings = identification_settings()
    return [
        _drift_after(records, twists, horizon, lever_arm, side_slip, pose_lag, settings.start_every)
        for horizon in (horizons or settings.horizons)
    ]


def rotation_centre(pose: FloatArray, lever_arm: tuple[float, float]) -> FloatArray:
    """Convert poses (..., 3) of a point `lever_arm` ahead and to the left of the rotation centre [m] to its poses."""
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
            raise ValueError(f"record '{record.name}': no pose; the drift of a prediction needs one")
        centre = rotation_centre(record.pose, lever_arm)
        lag, steps, stride = (round(time / record.dt) for time in (pose_lag, horizon, start_every))
        fresh = lag + np.flatnonzero(record.fresh_pose[lag : len(twist)])
        if not len(fresh):
            continue
        starts = np.unique(_nearest(fresh, np.arange(lag, len(twist) - steps, stride)))
        ends = _nearest(fresh, starts + steps)
        near = np.abs(ends - starts - steps) <= _NEAR * steps
        starts, ends = starts[near], ends[near]
        mean = 0.5 * (twist[1:] + twist[:-1])
        pose = centre[starts]
        for step in range(max(ends - starts, default=0)):
            (on,) = np.nonzero(step < ends - starts)
            v, omega = mean[starts[on] - lag + step].T
            pose[on] = integrate_pose(pose[on], v, omega, record.dt, side_slip)
        error = pose - centre[ends]
        errors.append(np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(wrap_angle(error[:, 2]))]))
    size = np.concatenate([np.empty((0, 2)), *errors])
    if not len(size):
        raise ValueError(f"no two poses of a record are {horizon:.3g} s apart; give longer records, or more poses")
    rmse = np.sqrt((size**2).mean(axis=0))
    mean_size = size.mean(axis=0)
    return PoseDrift(horizon, float(rmse[0]), float(rmse[1]), float(mean_size[0]), float(mean_size[1]), len(size))


def _nearest(rows: NDArray[np.int64], targets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the one of the sorted `rows` (n,) that is nearest to each of the `targets` (k,)."""
    after = np.searchsorted(rows, targets).clip(0, len(rows) - 1)
    before = rows[np.maximum(after - 1, 0)]
    return np.asarray(np.where(targets - before <= rows[after] - targets, before, rows[after]))


@dataclass(frozen=True)
class PoseResults:
    """Results of the calibration by poses.

    Attributes
    ----------
    parameters
        Parameters of wheels and gyro, SI units; empty without poses.
    laws
        Slip laws compared: name, and its calibration.
    drift
        Open-loop error of the validation records, one entry for each horizon.
    warnings
        Doubts about the result.
    """

    parameters: ParameterEstimate
    laws: tuple[tuple[str, PoseCalibration], ...]
    drift: tuple[PoseDrift, ...]
    warnings: tuple[Doubt, ...]

    @property
    def mount(self) -> tuple[str, ...]:
        """Names of the two parameters of the pose point's place, ahead and left; empty without them."""
        pairs = (_LEVER_ARM, ("mount.ahead", "mount.left"))
        return next((pair for pair in pairs if set(pair) <= set(self.parameters.names)), ())

    @property
    def place(self) -> tuple[float, float]:
        """Pose point ahead and to the left of the rotation centre [m]; zeros if they agree or nothing is known."""
        ahead, left = [self.parameters.value(name) for name in self.mount] or (0.0, 0.0)
        far = np.hypot(ahead, left) >= identification_settings().warn.lever_arm
        return (ahead, left) if far else (0.0, 0.0)

    def centred(self, records: Sequence[Record]) -> list[Record]:
        """Return the records with a pose, with poses of the rotation centre."""
        return [replace(r, pose=rotation_centre(np.asarray(r.pose), self.place)) for r in _with_pose(records)]


class PosePoint(NamedTuple):
    """Position and delay of a measured pose relative to the body's rotation centre."""

    lever_arm: tuple[float, float] = (0.0, 0.0)
    """Pose point ahead and to the left [m]."""
    side_slip: float = 0.0
    """Lateral speed over -v omega [s]."""
    lag: float = 0.0
    """Delay of poses [s]."""


NO_POSES = PoseResults(ParameterEstimate((), np.empty(0), np.empty((0, 0))), (), (), ())


def from_poses(data: LogData, fitted: Fitted) -> PoseResults:
    """Calibrate on the training records that have a pose, and predict the poses of the validation records.

    With too few poses, that part is left out with a warning.
    """
    train, validation = _with_pose(data.train), _with_pose(data.validation)
    if not train and not validation:
        return NO_POSES
    warnings: list[Doubt] = []
    laws = _slip_laws(train, fitted.geometry, warnings)
    if fitted.base and data.yaw == "gyro":
        pose_parameters = fitted.base.pose or NO_POSES.parameters
        return PoseResults(pose_parameters, laws, _drift(*_of_base(data, fitted.base), warnings), tuple(warnings))
    gyro = _gyro(train, warnings) if data.yaw == "gyro" else None
    calibrations = [("wheels", laws[0][1])] if laws else []
    calibrations += [("gyro", gyro)] if gyro else []
    warnings += [doubt.about("poses") for _, calibration in calibrations for doubt in calibration.warnings]
    parts = [calibration.parameters for _, calibration in calibrations]
    if parts and laws and fitted.geometry is None:
        parts[0] = _as_gains(parts[0])
    parameters = joined(parts) if parts else NO_POSES.parameters
    drift = _drift(*_of_model(data, fitted, laws[0][1].parameters if laws else None, gyro), warnings)
    return PoseResults(parameters, laws, drift, tuple(warnings))


def _slip_laws(
    train: Sequence[Record], geometry: WheelGeometry | None, warnings: list[Doubt]
) -> tuple[tuple[str, PoseCalibration], ...]:
    """Calibrate the law with a constant track first, then the others if the log has separate wheels."""
    if not train:
        return ()
    records = train if geometry else [_unit_wheels(record) for record in train]
    place = geometry or _UNIT_WHEELS
    candidates: dict[str, SlipLaw] = {"constant track": ConstantTrack(*place)} | (
        {"virtual track": GrowingTrack(*place), "slip polynomial": SlipPolynomial(*place)} if geometry else {}
    )
    try:
        return tuple((name, calibrate_wheels(records, law)) for name, law in candidates.items())
    except ValueError as error:
        warnings.append(Doubt("pose calibration", f"wheels are not calibrated from poses: {error}"))
        return ()


def _gyro(train: Sequence[Record], warnings: list[Doubt]) -> PoseCalibration | None:
    try:
        return calibrate_gyro(train) if train else None
    except ValueError as error:
        warnings.append(Doubt("pose calibration", f"the gyro is not calibrated from poses: {error}"))
        return None


def _of_model(
    data: LogData, fitted: Fitted, wheels: ParameterEstimate | None, gyro: PoseCalibration | None
) -> tuple[Predictions, PosePoint]:
    """Predict the body's twist, which is the calibrated output of the model, with the point of the measured pose."""
    place = fitted.geometry or _UNIT_WHEELS
    gain = np.ones(2)
    if wheels:
        gain[0] = wheels.value("wheel_radius") / place.radius
        if data.yaw == "encoders":
            gain[1] = gain[0] * place.track / wheels.value("track")
    if gyro:
        gain[1] = 1.0 / gyro.parameters.value("gyro_scale")
    predictions = [
        (record, gain * (outputs - fitted.offset))
        for record, outputs in zip(data.validation, fitted.simulated, strict=True)
        if record.pose is not None
    ]
    if wheels is None:
        return predictions, PosePoint()
    arm = (wheels.value(_LEVER_ARM[0]), wheels.value(_LEVER_ARM[1]))
    return predictions, PosePoint(arm, wheels.value("side_slip"))


def _of_base(data: LogData, base: IdentifiedBase) -> tuple[Predictions, PosePoint]:
    """Predict as `_of_model`, for poses from which the mount of the sensor is already removed."""
    records = _with_pose(data.validation)
    predictions = list(zip(records, base.body_twists(records), strict=True))
    if base.pose is None:
        return predictions, PosePoint()
    mount = PoseMount(**{name: base.pose.value(f"mount.{name}") for name in ("ahead", "left", "heading")})
    centred = [(replace(record, pose=mount.centre(np.asarray(record.pose))), twist) for record, twist in predictions]
    return centred, PosePoint(lag=base.pose.value("pose.delay"))


def _drift(predictions: Predictions, point: PosePoint, warnings: list[Doubt]) -> tuple[PoseDrift, ...]:
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


def _with_pose(records: Sequence[Record]) -> list[Record]:
    return [record for record in records if record.pose is not None]


def _unit_wheels(record: Record) -> Record:
    """Convert to wheels of 1 m radius, 1 m apart, with the twist of the record."""
    if record.twist is None:
        return record
    v, omega = record.twist.T
    wheels: FloatArray = np.column_stack([v - omega / 2, v + omega / 2])
    return replace(record, wheels=wheels)


def _as_gains(wheels: ParameterEstimate) -> ParameterEstimate:
    """Convert radius and track of unit wheels to gains, body over odometry."""
    names = ("longitudinal_gain", "yaw_gain", *wheels.names[2:])
    return wheels.derived(names, lambda row: np.concatenate([[row[0], row[0] / row[1]], row[2:]]))
