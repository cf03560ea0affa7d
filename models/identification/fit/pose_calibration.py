"""Calibration of slip, wheel geometry, gyro scale and pose point from measured poses.

The displacement of the body over short windows is predicted from the wheels and a slip law, or from the gyro, and
compared with the poses at both ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.log_data import divide
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.doubts import uncertain_parameters
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate, join_estimates
from diffdrive_mpc.models.output_error.statistics import residual_scale, sandwich, spike_weights
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle

_MIN_WINDOWS = 20
_ROUNDS = 6
# Window for the estimation of lags, as a share of the configured window; short windows have larger speed changes.
_LAG_WINDOW = 0.4
_SHIFTS = 3
_PARTS = 5


@dataclass(frozen=True)
class ConstantTrack:
    """Differential drive with an effective track and the lateral speed -side_slip v omega.

    Coefficients: wheel_radius [m], track [m], side_slip [s].

    Attributes
    ----------
    wheel_radius, track
        Nominal values [m], which are the initial values of the fit.
    """

    wheel_radius: float
    track: float
    names: tuple[str, ...] = ("wheel_radius", "track", "side_slip")

    @property
    def start(self) -> FloatArray:
        """Initial coefficients (3,)."""
        return np.array([self.wheel_radius, self.track, 0.0])

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """Compute v [m/s], speed to the left [m/s] and yaw rate [rad/s] (..., 3) from wheel rates (..., 2) [rad/s]."""
        radius, track, side_slip = coefficients
        v, difference = rim_speeds(radius, wheels)
        omega = difference / track
        return twist_with_side_slip(v, omega, side_slip)


def twist_with_side_slip(v: FloatArray, omega: FloatArray, side_slip: float) -> FloatArray:
    """Compute the twist (..., 3) of a body whose outward lateral speed is `side_slip` [s] times v omega."""
    return np.stack([v, -side_slip * v * omega, omega], axis=-1)


def rim_speeds(radius: float, wheels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute mean rim speed, and right minus left rim speed [m/s], from rates (..., 2) left, right [rad/s]."""
    left, right = wheels[..., 0], wheels[..., 1]
    return 0.5 * radius * (left + right), radius * (right - left)


class PoseWindows(NamedTuple):
    """The n windows of one record, with W steps each."""

    dt: float
    """Sample time [s]."""
    signal: FloatArray
    """Mean (n, W, c) of the signal over each step."""
    change: FloatArray
    """Change (n, c) of the signal from start to end of a window."""
    displacement: FloatArray
    """Displacement (n, 3) of the pose point in the frame of the first pose: ahead [m], to the left [m], turn [rad]."""


_Signal = Literal["wheels", "twist", "yaw_rate"]


def pose_windows(
    records: Sequence[Record], signal: _Signal, pose_lag: float = 0.0, share: float = 1.0
) -> list[PoseWindows]:
    """Cut records into windows of the configured length, without overlap and without gaps of the signal.

    Parameters
    ----------
    records
        Records with a pose.
    signal
        Signal that is cut into windows, in addition to the poses.
    pose_lag
        Age of the poses at their stamp, relative to the signal [s].
    share
        Window length as a share of the configured length [-].

    Raises
    ------
    ValueError
        If a record has no poses or signal, or if there are too few windows in total.
    """
    length = share * identification_settings().pose_window
    record_windows = [_cut_record(record, signal, pose_lag, length) for record in records]
    count = sum(len(windows.displacement) for windows in record_windows)
    if count < _MIN_WINDOWS:
        raise ValueError(f"{count} windows with a pose at both ends instead of {_MIN_WINDOWS}: record a longer log")
    return [windows for windows in record_windows if len(windows.displacement)]


def _cut_record(record: Record, name: _Signal, pose_lag: float, length: float) -> PoseWindows:
    value, pose = getattr(record, name), record.pose
    if value is None or pose is None:
        raise ValueError(f"record '{record.name}': a calibration from poses requires pose and {name}")
    signal = np.asarray(value).reshape(len(value), -1)
    mean = 0.5 * (signal[1:] + signal[:-1])
    steps, lag = max(2, round(length / record.dt)), round(pose_lag / record.dt)
    step = np.arange(len(pose)) - lag
    is_known = (step >= 0) & (step < len(mean))
    is_known[is_known] = np.isfinite(mean[step[is_known]]).all(axis=1)
    rows = np.array(record.pose_windows(steps, is_known), dtype=np.int64)
    signal_windows = mean[rows[:, None] - lag + np.arange(steps)]
    first, last = pose[rows], pose[rows + steps]
    change = last - first
    displacement = np.column_stack([*ahead_and_left(change, first[:, 2]), wrap_angle(change[:, 2])])
    return PoseWindows(record.dt, signal_windows, signal[rows - lag + steps] - signal[rows - lag], displacement)


@dataclass(frozen=True)
class PoseCalibration:
    """Calibration of wheels or gyro by poses.

    Attributes
    ----------
    parameters
        Coefficients. For wheels also lever_arm_ahead and lever_arm_left [m], the position of the pose point relative to
        the rotation centre.
    rmse
        Root mean square error over one window: ahead [m], to the left [m], heading [rad]; for a gyro, of the mean yaw
        rate [rad/s].
    windows
        Number of windows.
    warnings
        Doubts about the result.
    """

    parameters: ParameterEstimate
    rmse: FloatArray
    windows: int
    warnings: tuple[Doubt, ...]


def calibrate_wheels(records: Sequence[Record], law: ConstantTrack, pose_lag: float = 0.0) -> PoseCalibration:
    """Fit the coefficients of a slip law and the lever arm of the pose point.

    Parameters
    ----------
    records
        Records with wheels and pose.
    law
        Slip law with initial coefficients.
    pose_lag
        Age of the poses at their stamp, relative to the wheels [s].

    Raises
    ------
    ValueError
        If wheels or poses are missing, or there are too few windows.
    """
    windows = pose_windows(records, "wheels", pose_lag)
    count = len(law.names)

    def errors(parameters: FloatArray) -> FloatArray:
        parts = []
        for part in windows:
            predicted = displacement(law.twist(parameters[:count], part.signal), part.dt, parameters[count:])
            error = part.displacement - predicted
            error[:, 2] = wrap_angle(error[:, 2])
            parts.append(error)
        return np.concatenate(parts)

    return _solve(errors, np.append(law.start, np.zeros(2)), (*law.names, "lever_arm_ahead", "lever_arm_left"))


def calibrate_gyro(records: Sequence[Record], pose_lag: float = 0.0) -> PoseCalibration:
    """Fit gyro_scale [-] and gyro_offset [rad/s] in: gyro reading = gyro_scale (true yaw rate) + gyro_offset.

    Parameters
    ----------
    records
        Records with gyro and pose.
    pose_lag
        Age of the poses at their stamp, relative to the gyro [s].

    Raises
    ------
    ValueError
        If gyro or poses are missing, or there are too few windows.
    """
    windows = pose_windows(records, "yaw_rate", pose_lag)
    measured = np.concatenate([part.signal[..., 0].mean(axis=1) for part in windows])
    pose_rate = np.concatenate([part.displacement[:, 2] / (part.signal.shape[1] * part.dt) for part in windows])

    def errors(parameters: FloatArray) -> FloatArray:
        # The residual is that of the poses: as a regressor, their noise would reduce the scale.
        return np.asarray(pose_rate - (measured - parameters[1]) / parameters[0])[:, None]

    return _solve(errors, np.array([1.0, 0.0]), ("gyro_scale", "gyro_offset"))


def calibrate_lags(records: Sequence[Record]) -> ParameterEstimate:
    """Estimate the lags of wheels and gyro relative to poses, `wheels.lag` and `gyro.lag` [s], and `wheels.scale` [-].

    For a reading r with lag L, the motion over a window is s = (integral of r + L (r_end - r_start)) / scale, plus the
    effect of the lever arm of the pose point, or of the bias of the gyro. The yaw rate of the wheels is not used,
    because the body of a skid-steered robot lags behind it. Without a gyro, the result does not contain `gyro.lag`.

    Raises
    ------
    ValueError
        If wheels or poses are missing, or there are too few windows.
    """
    wheels = pose_windows(records, "twist", share=_LAG_WINDOW)
    halves = [0.5 * part.displacement[:, 2] for part in wheels]
    ahead = [
        (np.cos(h) * part.displacement[:, 0] + np.sin(h) * part.displacement[:, 1]) / np.sinc(h / np.pi)
        for h, part in zip(halves, wheels, strict=True)
    ]
    encoders = (
        _fit_lag(wheels, ahead, [2 * np.sin(h) for h in halves]).renamed("wheels").part(["wheels.lag", "wheels.scale"])
    )
    if any(record.yaw_rate is None for record in records):
        return encoders
    gyro = pose_windows(records, "yaw_rate", share=_LAG_WINDOW)
    turns = [part.displacement[:, 2] for part in gyro]
    return join_estimates(
        [encoders, _fit_lag(gyro, turns, [np.ones_like(turn) for turn in turns]).renamed("gyro").part(["gyro.lag"])]
    )


def calibrate_delay(records: Sequence[Record]) -> ParameterEstimate:
    """Estimate the delay of poses relative to the gyro, `pose.delay` [s]; negative if the gyro has the larger delay.

    The standard deviation is at least that of the estimates without one part of the records, because a drive with poor
    poses leads to a clear minimum in each part, but not to the same one.

    Raises
    ------
    ValueError
        If gyro or poses are missing, or there are too few windows.
    """
    estimate, rest, parts = _fit_delay(records), list(records), list[list[Record]]()
    for count in range(_PARTS, 1, -1):
        part, rest = divide(rest, 1 / count)
        parts.append(part)
    parts.append(rest)
    others = [[record for part in parts if part is not omitted for record in part] for omitted in parts]
    variance = (_PARTS - 1) * np.var([_fit_delay(part).value("pose.delay") for part in others])
    return replace(estimate, covariance=np.maximum(estimate.covariance, variance))


def _fit_delay(records: Sequence[Record]) -> ParameterEstimate:
    """Fit the delay of poses relative to the gyro.

    A lag approximates a delay only for small changes of the reading. The windows are therefore shifted by whole samples
    until the remaining delay is less than one sample.
    """
    dt, steps = records[0].dt, 0
    for _ in range(_SHIFTS):
        gyro = pose_windows(records, "yaw_rate", steps * dt, _LAG_WINDOW)
        turns = [part.displacement[:, 2] for part in gyro]
        remaining = _fit_lag(gyro, turns, [np.ones_like(turn) for turn in turns]).part(["lag"])
        delay = steps * dt - remaining.value("lag")
        estimate, steps = ParameterEstimate(("pose.delay",), np.array([delay]), remaining.covariance), round(delay / dt)
    return estimate


def _fit_lag(
    windows: Sequence[PoseWindows], motion: Sequence[FloatArray], disturbance: Sequence[FloatArray]
) -> ParameterEstimate:
    """Fit lag and scale of the first column of a signal, and the factor of `disturbance` (n,), to `motion` (n,)."""
    signals = [part.signal[..., 0] for part in windows]
    integral = np.concatenate([part.dt * signal.sum(axis=1) for part, signal in zip(windows, signals, strict=True)])
    change = np.concatenate([part.change[:, 0] for part in windows])
    motions, disturbances = np.concatenate(motion), np.concatenate(disturbance)

    def errors(parameters: FloatArray) -> FloatArray:
        lag, scale, factor = parameters
        return np.asarray(motions - (integral + lag * change) / scale - factor * disturbances)[:, None]

    return _solve(errors, np.array([0.0, 1.0, 0.0]), ("lag", "scale", "disturbance")).parameters


def displacement(twist: FloatArray, dt: float, lever_arm: FloatArray) -> FloatArray:
    """Compute the displacement (n, 3) of a body point in its initial frame: ahead [m], to the left [m], turn [rad].

    Parameters
    ----------
    twist
        Forward and lateral speed [m/s] and yaw rate [rad/s] (n, W, 3), constant over each of the W steps.
    dt
        Duration of a step [s].
    lever_arm
        Position (2,) of the point relative to the rotation centre: ahead, to the left [m].
    """
    turns = np.cumsum(twist[..., 2] * dt, axis=1)
    half_turn = 0.5 * twist[..., 2] * dt
    heading = turns - half_turn
    chord = dt * np.sinc(half_turn / np.pi)
    c, s = np.cos(heading), np.sin(heading)
    x = np.sum(chord * (c * twist[..., 0] - s * twist[..., 1]), axis=1)
    y = np.sum(chord * (s * twist[..., 0] + c * twist[..., 1]), axis=1)
    end = turns[:, -1]
    ahead, left = lever_arm
    x += np.cos(end) * ahead - np.sin(end) * left - ahead
    y += np.sin(end) * ahead + np.cos(end) * left - left
    return np.column_stack([x, y, end])


def _solve(errors: Callable[[FloatArray], FloatArray], start: FloatArray, names: tuple[str, ...]) -> PoseCalibration:
    """Minimise the squared window errors (n, r), with iterative weights from their scale and spikes."""
    parameters, residuals = start, errors(start)
    spread = np.maximum(residuals.std(axis=0), np.finfo(float).tiny)
    for _ in range(_ROUNDS):
        robust_weights = spike_weights([residuals])
        weight = np.sqrt(robust_weights[0]) / residual_scale([residuals], robust_weights, spread)
        result = least_squares(_apply_weight(errors, weight), parameters, jac="3-point", x_scale="jac")
        parameters, residuals = result.x, errors(result.x)
    rows = result.jac.reshape(*residuals.shape, len(start))
    estimate = ParameterEstimate(names, parameters, sandwich([rows], [weight * residuals]).covariance)
    warnings = uncertain_parameters(estimate.part([name for name in names if name in _NONZERO]), "pose calibration")
    return PoseCalibration(estimate, np.sqrt(np.mean(residuals**2, axis=0)), len(residuals), tuple(warnings))


def _apply_weight(errors: Callable[[FloatArray], FloatArray], weight: FloatArray) -> Callable[[FloatArray], FloatArray]:
    return lambda parameters: (weight * errors(parameters)).ravel()


_NONZERO = ("wheel_radius", "track", "p0", "gyro_scale")
"""Parameters whose true value cannot be zero."""
