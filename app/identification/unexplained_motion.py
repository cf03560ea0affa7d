"""Unexplained motion of a robot in validation data; trial drives add blocks of it to the motion of a plant."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import nnls

from diffdrive_mpc.app.identification.trial_drives import log_sensors, log_slip, trial_settings
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.deliver.configuration import MODEL_FILE
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.statistics import student_factor
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.sim.plants.identified_robot import IdentifiedRobot, intensity_features, intervals, smoothed
from diffdrive_mpc.sim.plants.surface import BodySlip

_MIN_POSES = 4
_MIN_VARIANCE = 0.1
"""Minimum constant variance as a share of the mean variance [-], because logs have little straight, steady motion."""
_HEADER = (
    "# Robot of the log, for `--plant model:FILE`, `predict-error` and `prove`: model, surface, sensors, and\n"
    "# unexplained motion with its variance by speeds and rates, and intervals of samples and multiples of its\n"
    "# deviation.\n"
)


def unexplained_motion(identification: Identification) -> tuple[list[FloatArray], list[FloatArray]]:
    """Compute measured minus predicted twists (K, 3), and squared fast displacements (K,), of each validation record.

    The twists are means over windows. The columns are forward and lateral speed [m/s] and yaw rate [rad/s] of the
    rotation centre on the surface of the log. Measured twists are computed from poses. For records without poses they
    are those of encoders and gyro, with zero lateral speed. The squared displacements [m^2] are those of single poses
    from the motion between the means, forward, minus the power of the noise; NaN without a pose.
    """
    report = identification.report
    slip, load_shift = log_slip(identification), identification.config["estimator"]["load_shift"]
    motion, squares = [], []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        assert record.twist is not None
        displacements = np.full(len(outputs), np.nan)
        yaw_rate = record.yaw_rate if report.data.yaw == "gyro" else None
        errors = np.column_stack([record.twist[:, 0], np.zeros(len(outputs)), record.twist[:, 1]])
        errors[:, 2] = errors[:, 2] if yaw_rate is None else yaw_rate
        errors[:, [0, 2]] -= outputs
        steps = max(1, round(trial_settings().window / record.dt))
        errors = _block_means(np.nan_to_num(errors), np.arange(0, len(errors) + 1, steps))
        if record.pose is not None:
            predicted = slip.body((outputs - report.fitted.offset).T).T
            predicted[:, 1] += load_shift * np.gradient(predicted[:, 0], record.dt) * predicted[:, 2]
            yaw_rates = predicted[:, 2] if yaw_rate is None else np.nan_to_num(yaw_rate - report.fitted.offset[1])
            by_pose = _motion_from_poses(report.poses.at_rotation_centre([record])[0], predicted, yaw_rates)
            if by_pose is not None:
                slow, displacements = by_pose
                errors = np.column_stack([slow[:, :2], (slow if yaw_rate is None else errors)[:, 2]])
        motion.append(errors)
        squares.append(displacements)
    return motion, squares


def identified_robot(identification: Identification, config: ControllerConfig) -> IdentifiedRobot | None:
    """Build the robot of the log, with sensors like those of the log, for simulations; None if no motion is known.

    The variance of the unexplained motion is a non-negative linear function of squared speeds and rates, fitted by
    least squares, so that large variances in sharp turns do not affect straight and steady motion.
    """
    report = identification.report
    motion, displacements = unexplained_motion(identification)
    motion = [rows for rows in motion if len(rows)]
    if not motion:
        return None
    identified = report.fitted.identified
    deviations = _deviations(identified.parameters, ("{0}.gain", "gain.{0}_ref_to_{0}"))
    slip, deviation = _subtract_slip(
        motion, [rows - report.fitted.offset for rows in report.fitted.simulated], identification
    )
    features, sample_features = [], []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        twist = np.nan_to_num(outputs - report.fitted.offset)
        steps = max(1, round(trial_settings().window / record.dt))
        squares = intensity_features(twist, np.gradient(twist, record.dt, axis=0))
        sample_features.append(smoothed(squares, record.dt))
        features.append(_block_means(squares, np.r_[np.arange(0, len(squares), steps), len(squares)]))
    all_features, errors = np.concatenate(features), np.concatenate(motion)
    variance = np.array([nnls(all_features, column**2)[0] for column in errors.T])
    variance[:, 0] = np.maximum(variance[:, 0], _MIN_VARIANCE * (errors**2).mean(axis=0))
    variance = np.maximum(variance, [[np.finfo(float).eps, 0, 0, 0, 0, 0]])
    fast = np.concatenate(displacements)
    measured = np.isfinite(fast)
    displacement = nnls(np.concatenate(sample_features)[measured], fast[measured])[0] if measured.any() else np.zeros(6)
    # The constant part contains noise with a correlation in time, which is no motion.
    displacement[0] = 0.0
    normalised = [row / np.sqrt(squares @ variance.T) for row, squares in zip(motion, features, strict=True)]
    return IdentifiedRobot(
        model=MODEL_FILE,
        slip=slip,
        sensors=log_sensors(identification, config),
        sample_time=identification.report.data.validation[0].dt,
        block_time=identification_settings().block_time,
        gain_deviation=(deviations[0] if deviation is None else deviation, deviations[1]),
        delay_deviation=_deviations(identified.delays, ("{0}.sum",)),
        variance=_round_values(variance),
        displacement=_round_values(displacement),
        largest=_round_values(all_features.max(axis=0)),
        motion=[intervals(row) for row in normalised],
    )


def _subtract_slip(
    motion: list[FloatArray], outputs: Sequence[FloatArray], identification: Identification
) -> tuple[BodySlip, float | None]:
    """Estimate the slip of the surface from poses, and subtract it from `motion`, so that only random motion remains.

    Return the slip and the standard deviation of the forward gain over blocks, which is None if there are no poses.

    Slip is estimated from poses, because encoders measure neither wheel radius nor side-slip. Records without poses are
    not changed. The gain is computed from means over long blocks, in which responses to commands average out.
    """
    slip, validation = log_slip(identification, pose_point=True), identification.report.data.validation
    pairs = [
        pair
        for pair, record in zip(zip(motion, outputs, strict=True), validation, strict=True)
        if record.pose is not None
    ]
    if not pairs:
        return slip, None
    block = round(identification_settings().block_time / validation[0].dt)
    forward, v = (
        np.concatenate([np.convolve(part[:, 0], np.ones(min(block, len(part))), "valid") for part in parts])
        for parts in zip(*pairs, strict=True)
    )
    lateral, v_omega = np.concatenate([[errors[:, 1], twist.prod(axis=1)] for errors, twist in pairs], axis=1)
    gain, side_slip = forward @ v / (v @ v), max(-(lateral @ v_omega) / (v_omega @ v_omega), -slip.side_slip)
    deviation = math.sqrt(block * np.sum(((forward - gain * v) * v) ** 2)) / (v @ v)
    deviation *= student_factor(max(1, sum(len(errors) for errors, _ in pairs) // block - 1))
    for errors, twist in pairs:
        errors[:, 0] -= gain * twist[:, 0]
        errors[:, 1] += side_slip * twist.prod(axis=1)
    values = {"longitudinal_gain": slip.longitudinal_gain + gain, "side_slip": slip.side_slip + side_slip}
    slip = slip.model_copy(update={name: float(f"{value:.4g}") for name, value in values.items()})
    return slip, float(f"{deviation:.3g}")


def _round_values(values: FloatArray) -> Any:  # noqa: ANN401 - tuples of the schema
    """Round values to the number of digits of a robot file."""
    return [_round_values(row) for row in values] if values.ndim > 1 else [float(f"{value:.4g}") for value in values]


def _deviations(estimate: ParameterEstimate | None, names: Sequence[str]) -> tuple[float, float]:
    """Return the standard deviations of v and omega, each of the first of `names` in the estimate; 0 if missing."""
    by_name = {} if estimate is None else {name: deviation for name, _, deviation in estimate.rows}
    v, omega = (next((by_name[name.format(c)] for name in names if name.format(c) in by_name), 0.0) for c in CHANNELS)
    return float(f"{v:.3g}"), float(f"{omega:.3g}")


def write_robot(robot: IdentifiedRobot, path: Path) -> None:
    """Write a robot file to `path`; raise OSError on failure."""
    text = yaml.safe_dump(robot.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    path.write_text(f"{_HEADER}{text}", encoding="utf-8")


def _block_means(rows: FloatArray, ends: AnyArray) -> FloatArray:
    """Replace rows (K, n) by their means over the blocks between `ends`; rows outside the blocks are zero."""
    means = np.zeros_like(rows)
    for start, end in itertools.pairwise(ends):
        means[start:end] = rows[start:end].mean(axis=0)
    return means


def _motion_from_poses(
    record: Record, predicted: FloatArray, yaw_rates: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Compute twists (K, 3) and squared displacements (K,) of `unexplained_motion` from poses; None for too few poses.

    The heading is the integral of the yaw rates (K,) [rad/s], aligned with the poses in a moving window, because it has
    less noise than single poses. Displacements are differences between the mean poses of consecutive windows. The
    windows are long enough that pose noise has a small effect, and the remaining power of the noise is subtracted.
    """
    assert record.pose is not None and record.fresh_pose is not None
    dt, fresh = record.dt, record.fresh_pose
    if np.count_nonzero(fresh) < _MIN_POSES:
        return None
    integrated_turn = dt * np.cumsum(yaw_rates)
    half = round(identification_settings().pose_window / dt)
    offset = np.where(fresh, record.pose[:, 2] - integrated_turn, 0.0)
    window = np.ones(2 * half + 1)
    weight = np.maximum(np.convolve(fresh, window, "same"), 1.0)
    heading = integrated_turn + np.convolve(offset, window, "same") / weight
    # The motion between two samples has the mean velocity and heading of the body.
    mean = 0.5 * (predicted + np.vstack([predicted[:1], predicted[:-1]]))
    path = dt * np.cumsum((mean[:, 0] + 1j * mean[:, 1]) * np.exp(1j * (heading - 0.5 * dt * yaw_rates)))
    position_error = record.pose[:, 0] + 1j * record.pose[:, 1] - path
    heading_error = record.pose[:, 2] - dt * np.cumsum(mean[:, 2])
    # Second differences of smooth motion are negligible, so second differences of the errors are noise, with six times
    # its variance.
    pose_error = (position_error, heading_error)
    noise = np.array([np.mean(np.abs(np.diff(error[fresh], 2)) ** 2) / 6.0 for error in pose_error])
    noise[0] /= 2.0
    steps = max(half, round(math.sqrt(2.0 * noise[0]) / trial_settings().noise_speed / dt), 1)
    poses = np.flatnonzero(fresh)
    groups = np.split(poses, np.flatnonzero(np.diff(poses // steps)) + 1)
    if len(groups) < _MIN_POSES:
        return None
    centres = np.array([round(group.mean()) for group in groups])
    starts, ends = centres[:-1], centres[1:]
    means = np.array([position_error[group].mean() for group in groups])
    displacement = np.diff(means) * np.exp(-1j * heading[(starts + ends) // 2])
    windows = np.column_stack(
        [displacement.real, displacement.imag, np.diff([heading_error[group].mean() for group in groups])]
    )
    power = np.maximum((windows**2).mean(axis=0), np.finfo(float).tiny)
    noise_share = 2.0 * np.mean([1.0 / len(group) for group in groups])
    windows *= np.sqrt(np.maximum(1.0 - noise_share * noise[[0, 0, 1]] / power, 0.0))
    errors = np.zeros((len(fresh), 3))
    errors[starts[0] : ends[-1]] = np.repeat(windows / (dt * (ends - starts))[:, None], ends - starts, axis=0)
    slow = np.interp(np.arange(len(fresh)), centres, means)
    fast = ((position_error - slow) * np.exp(-1j * heading)).real ** 2 - noise[0]
    fast[~fresh] = np.nan
    fast[: centres[0]] = fast[centres[-1] :] = np.nan
    return errors, fast
