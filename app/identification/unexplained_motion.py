"""Unexplained motion of a robot in held-out data, which trial drives add to the motion of a plant in blocks."""

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
from diffdrive_mpc.sim.plants.identified_robot import IdentifiedRobot, intensity_features, intervals
from diffdrive_mpc.sim.plants.surface import BodySlip

_MIN_POSES = 4
_MIN_VARIANCE = 0.1
"""Minimum constant variance as a share of the mean variance [-], because logs have few straight and steady parts."""
_HEAD = (
    "# Robot of the log, for `--plant model:FILE`, `predict-error` and `prove`: model, surface, sensors, and\n"
    "# unexplained motion with its variance by speeds and rates, and intervals of samples and multiples of its\n"
    "# deviation.\n"
)


def unexplained_motion(identification: Identification) -> list[FloatArray]:
    """Return measured minus predicted twists (K, 3) of each held-out record, as means over windows.

    The columns are forward and lateral speed [m/s] and yaw rate [rad/s] of the rotation centre on the surface of the
    log. Measured twists are from poses if the record has them, else from encoders and gyro, without lateral speed.
    """
    report = identification.report
    slip, load_shift = log_slip(identification), identification.config["estimator"]["load_shift"]
    motion = []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        assert record.twist is not None
        yaw_rate = record.yaw_rate if report.data.yaw == "gyro" else None
        rows = np.column_stack([record.twist[:, 0], np.zeros(len(outputs)), record.twist[:, 1]])
        rows[:, 2] = rows[:, 2] if yaw_rate is None else yaw_rate
        rows[:, [0, 2]] -= outputs
        steps = max(1, round(trial_settings().window / record.dt))
        rows = _means(np.nan_to_num(rows), np.arange(0, len(rows) + 1, steps))
        if record.pose is not None:
            predicted = slip.body((outputs - report.fitted.offset).T).T
            predicted[:, 1] += load_shift * np.gradient(predicted[:, 0], record.dt) * predicted[:, 2]
            turning = predicted[:, 2] if yaw_rate is None else np.nan_to_num(yaw_rate - report.fitted.offset[1])
            from_poses = _motion_from_poses(report.poses.at_rotation_centre([record])[0], predicted, turning)
            if from_poses is not None:
                rows = np.column_stack([from_poses[:, :2], (from_poses if yaw_rate is None else rows)[:, 2]])
        motion.append(rows)
    return motion


def identified_robot(identification: Identification, config: ControllerConfig) -> IdentifiedRobot | None:
    """Return the robot of the log for simulation with the poses of the log; None without unexplained motion.

    The variance of the motion is a non-negative linear function of squared speeds and rates, fitted by least squares,
    so that the variance in sharp turns does not apply to straight and steady driving.
    """
    report = identification.report
    motion = [rows for rows in unexplained_motion(identification) if len(rows)]
    if not motion:
        return None
    identified = report.fitted.identified
    deviations = _deviations(identified.parameters, ("{0}.gain", "gain.{0}_ref_to_{0}"))
    slip, deviation = _subtract_slip(
        motion, [rows - report.fitted.offset for rows in report.fitted.simulated], identification
    )
    features = []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        twist = np.nan_to_num(outputs - report.fitted.offset)
        steps = max(1, round(trial_settings().window / record.dt))
        squares = intensity_features(twist, np.gradient(twist, record.dt, axis=0))
        features.append(_means(squares, np.r_[np.arange(0, len(squares), steps), len(squares)]))
    known, rows = np.concatenate(features), np.concatenate(motion)
    variance = np.array([nnls(known, column**2)[0] for column in rows.T])
    variance[:, 0] = np.maximum(variance[:, 0], _MIN_VARIANCE * (rows**2).mean(axis=0))
    variance = np.maximum(variance, [[np.finfo(float).eps, 0, 0, 0, 0, 0]])
    scaled = [row / np.sqrt(squares @ variance.T) for row, squares in zip(motion, features, strict=True)]
    return IdentifiedRobot(
        model=MODEL_FILE,
        slip=slip,
        sensors=log_sensors(identification, config),
        sample_time=identification.report.data.validation[0].dt,
        block_time=identification_settings().block_time,
        gain_deviation=(deviations[0] if deviation is None else deviation, deviations[1]),
        delay_deviation=_deviations(identified.delays, ("{0}.sum",)),
        variance=_rounded(variance),
        largest=_rounded(known.max(axis=0)),
        motion=[intervals(row) for row in scaled],
    )


def _subtract_slip(
    motion: list[FloatArray], outputs: Sequence[FloatArray], identification: Identification
) -> tuple[BodySlip, float | None]:
    """Return the slip of the surface according to the poses, and subtract it from `motion`, which is random only.

    Return also the standard deviation of the forward gain from the scatter of blocks; None without poses.

    Encoders measure neither the wheel radius nor side-slip. Records without poses are unchanged. The gain is computed
    from means over blocks; in shorter blocks the response to changes of the command would affect it.
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
    ahead, v = (
        np.concatenate([np.convolve(part[:, 0], np.ones(min(block, len(part))), "valid") for part in parts])
        for parts in zip(*pairs, strict=True)
    )
    left, turning = np.concatenate([[rows[:, 1], twist.prod(axis=1)] for rows, twist in pairs], axis=1)
    gain, side_slip = ahead @ v / (v @ v), max(-(left @ turning) / (turning @ turning), -slip.side_slip)
    deviation = math.sqrt(block * np.sum(((ahead - gain * v) * v) ** 2)) / (v @ v)
    deviation *= student_factor(max(1, sum(len(rows) for rows, _ in pairs) // block - 1))
    for rows, twist in pairs:
        rows[:, 0] -= gain * twist[:, 0]
        rows[:, 1] += side_slip * twist.prod(axis=1)
    values = {"longitudinal_gain": slip.longitudinal_gain + gain, "side_slip": slip.side_slip + side_slip}
    slip = slip.model_copy(update={name: float(f"{value:.4g}") for name, value in values.items()})
    return slip, float(f"{deviation:.3g}")


def _rounded(values: FloatArray) -> Any:  # noqa: ANN401 - tuples of the schema
    """Round numbers to the digits of a robot file."""
    return [_rounded(row) for row in values] if values.ndim > 1 else [float(f"{value:.4g}") for value in values]


def _deviations(estimate: ParameterEstimate | None, names: Sequence[str]) -> tuple[float, float]:
    """Return the standard deviations of v and omega, each for the first known name; 0 if no name is known."""
    rows = {} if estimate is None else {name: deviation for name, _, deviation in estimate.rows}
    v, omega = (next((rows[name.format(c)] for name in names if name.format(c) in rows), 0.0) for c in CHANNELS)
    return float(f"{v:.3g}"), float(f"{omega:.3g}")


def write_robot(robot: IdentifiedRobot, path: Path) -> None:
    """Write a robot file; raise OSError on failure."""
    text = yaml.safe_dump(robot.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    path.write_text(f"{_HEAD}{text}", encoding="utf-8")


def _means(rows: FloatArray, ends: AnyArray) -> FloatArray:
    """Replace rows (K, n) by their means between `ends`; rows outside are zero."""
    means = np.zeros_like(rows)
    for first, stop in itertools.pairwise(ends):
        means[first:stop] = rows[first:stop].mean(axis=0)
    return means


def _motion_from_poses(record: Record, predicted: FloatArray, turning: FloatArray) -> FloatArray | None:
    """Return measured minus predicted twists (K, 3) from the displacements between poses; None for too few poses.

    The heading is the integral of the yaw rate `turning` (K,) [rad/s], aligned with the poses in a window, which has
    less noise than single poses. Displacements are between the mean poses of consecutive windows. The windows are long
    enough for a small effect of pose noise, and the power of the noise is subtracted.
    """
    assert record.pose is not None and record.fresh_pose is not None
    dt, fresh = record.dt, record.fresh_pose
    if np.count_nonzero(fresh) < _MIN_POSES:
        return None
    integrated_turn = dt * np.cumsum(turning)
    half = round(identification_settings().pose_window / dt)
    offset = np.where(fresh, record.pose[:, 2] - integrated_turn, 0.0)
    window = np.ones(2 * half + 1)
    heading = integrated_turn + np.convolve(offset, window, "same") / np.maximum(
        np.convolve(fresh, window, "same"), 1.0
    )
    # Between two samples the mean heading of the body applies.
    path = dt * np.cumsum((predicted[:, 0] + 1j * predicted[:, 1]) * np.exp(1j * (heading - 0.5 * dt * turning)))
    position_error = record.pose[:, 0] + 1j * record.pose[:, 1] - path
    heading_error = record.pose[:, 2] - dt * np.cumsum(predicted[:, 2])
    # Second differences of smooth motion are negligible, so they contain the noise.
    noise = np.array([np.mean(np.abs(np.diff(rows[fresh], 2)) ** 2) / 6.0 for rows in (position_error, heading_error)])
    noise[0] /= 2.0
    steps = max(half, round(math.sqrt(2.0 * noise[0]) / trial_settings().noise_speed / dt), 1)
    poses = np.flatnonzero(fresh)
    groups = np.split(poses, np.flatnonzero(np.diff(poses // steps)) + 1)
    if len(groups) < _MIN_POSES:
        return None
    centres = np.array([round(group.mean()) for group in groups])
    first, last = centres[:-1], centres[1:]
    displacement = np.diff([position_error[group].mean() for group in groups]) * np.exp(
        -1j * heading[(first + last) // 2]
    )
    windows = np.column_stack(
        [displacement.real, displacement.imag, np.diff([heading_error[group].mean() for group in groups])]
    )
    power = np.maximum((windows**2).mean(axis=0), np.finfo(float).tiny)
    share = 2.0 * np.mean([1.0 / len(group) for group in groups])
    windows *= np.sqrt(np.maximum(1.0 - share * noise[[0, 0, 1]] / power, 0.0))
    rows = np.zeros((len(fresh), 3))
    rows[first[0] : last[-1]] = np.repeat(windows / (dt * (last - first))[:, None], last - first, axis=0)
    return rows
