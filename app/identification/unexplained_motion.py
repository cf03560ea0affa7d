"""Unexplained motion of a robot in validation data; trial drives add blocks of it to the motion of a plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
_GYRO_WINDOW = 0.1
"""Window of the mean yaw rates of a gyro [s]; it removes most of the noise, and preserves swaying about the path."""
_MIN_VARIANCE = 0.1
"""Minimum constant variance as a share of the mean variance [-], because logs have little straight, steady motion."""
_HEADER = (
    "# Robot of the log, for `--plant model:FILE`, `predict-error` and `prove`: model, surface, sensors, and\n"
    "# unexplained motion with its variance by speeds and rates, and intervals of samples and multiples of its\n"
    "# deviation.\n"
)


def unexplained_motion(identification: Identification) -> tuple[list[FloatArray], float, float]:
    """Compute measured minus predicted twists (K, 3) of each validation record, traction slip, and fast displacement.

    The twists are means over windows. The columns are forward and lateral speed [m/s] and yaw rate [rad/s] of the
    rotation centre on the surface of the log. Measured twists are computed from poses, except for yaw rates of a gyro.
    For records without poses they are those of encoders and gyro, with zero lateral speed.

    The traction slip c [s^2/rad] is fitted to all poses; the prediction includes the slip c |omega| dv/dt. The fast
    displacement [m] is the standard deviation of single poses, without their noise, from the motion between the means.
    """
    report = identification.report
    slip, load_shift = log_slip(identification), identification.config["estimator"]["load_shift"]
    motion, by_pose = [], []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        assert record.twist is not None
        yaw_rate = record.yaw_rate if report.data.yaw == "gyro" else None
        errors = np.column_stack([record.twist[:, 0], np.zeros(len(outputs)), record.twist[:, 1]])
        errors[:, 2] = errors[:, 2] if yaw_rate is None else yaw_rate
        errors[:, [0, 2]] -= outputs
        yaw_window = trial_settings().window if yaw_rate is None else _GYRO_WINDOW
        windows = (trial_settings().window, trial_settings().window, yaw_window)
        columns = zip(np.nan_to_num(errors).T, windows, strict=True)
        motion.append(np.column_stack([_block_means(column, window / record.dt) for column, window in columns]))
        if record.pose is not None:
            predicted = slip.body((outputs - report.fitted.offset).T).T
            predicted[:, 1] += load_shift * np.gradient(predicted[:, 0], record.dt) * predicted[:, 2]
            yaw_rates = predicted[:, 2] if yaw_rate is None else np.nan_to_num(yaw_rate - report.fitted.offset[1])
            pose_errors = _PoseErrors.create(report.poses.at_rotation_centre([record])[0], predicted, yaw_rates)
            if pose_errors is not None:
                by_pose.append((pose_errors, motion[-1][:, : 3 if yaw_rate is None else 2]))
    if not by_pose:
        return motion, 0.0, 0.0
    fast = np.concatenate([errors.fast for errors, _ in by_pose])
    traction_slip = max(0.0, -(fast[:, 0] @ fast[:, 1]) / max(fast[:, 1] @ fast[:, 1], np.finfo(float).tiny))
    for errors, columns in by_pose:
        columns[:] = errors.twists(traction_slip)[:, : columns.shape[1]]
    noise = np.average([errors.noise[0] for errors, _ in by_pose], weights=[len(errors.fast) for errors, _ in by_pose])
    variance = np.mean((fast @ [1.0, traction_slip]) ** 2) - noise
    return motion, float(traction_slip), math.sqrt(max(0.0, variance))


def identified_robot(identification: Identification, config: ControllerConfig) -> IdentifiedRobot | None:
    """Build the robot of the log, with sensors like those of the log, for simulations; None if no motion is known.

    The variance of the unexplained motion is a non-negative linear function of squared speeds and rates. Iteratively
    weighted least squares converge to maximum likelihood, so that large errors do not determine small variances.
    """
    report = identification.report
    motion, traction_slip, displacement = unexplained_motion(identification)
    motion = [rows for rows in motion if len(rows)]
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
        squares = intensity_features(twist, np.gradient(twist, record.dt, axis=0))
        features.append(_block_means(squares, trial_settings().window / record.dt))
    all_features, errors = np.concatenate(features), np.concatenate(motion)
    variance = np.array([_fit_variance(all_features, column**2) for column in errors.T])
    variance[:, 0] = np.maximum(variance[:, 0], _MIN_VARIANCE * (errors**2).mean(axis=0))
    variance = np.maximum(variance, [[np.finfo(float).eps, 0, 0, 0, 0, 0]])
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
        traction_slip=float(f"{traction_slip:.4g}"),
        displacement=float(f"{displacement:.4g}"),
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


def _fit_variance(features: FloatArray, squares: FloatArray) -> FloatArray:
    """Fit non-negative coefficients of features (K, 6) to squares (K,) of normal errors."""
    variance = np.full(len(squares), max(squares.mean(), np.finfo(float).tiny))
    lower = _MIN_VARIANCE * variance
    for _ in range(20):
        coefficients = nnls(features / variance[:, None], squares / variance)[0]
        variance = np.maximum(features @ coefficients, lower)
    return np.asarray(coefficients)


def _block_means(rows: FloatArray, samples: float) -> FloatArray:
    """Replace rows (K, ...) by their means over blocks of the rounded number of `samples`; the last may be shorter."""
    means, steps = np.zeros_like(rows), max(1, round(samples))
    for start in range(0, len(rows), steps):
        means[start : start + steps] = rows[start : start + steps].mean(axis=0)
    return means


def _middle(rows: FloatArray) -> FloatArray:
    """Return means of consecutive rows, the first of which is unchanged."""
    return np.asarray(0.5 * (rows + np.concatenate([rows[:1], rows[:-1]])))


@dataclass(frozen=True)
class _PoseErrors:
    """Differences of the poses of a record from its predicted motion.

    Attributes
    ----------
    record
        Record with poses of the rotation centre.
    heading
        (K,) heading [rad]: the integral of the yaw rates, aligned with the poses in a moving window, because it has
        less noise than single poses.
    position
        (K, 2) complex: measured minus predicted position [m], and displacement by the traction |omega| dv/dt [m rad/s^2].
    turn
        (K,) measured minus predicted heading [rad].
    noise
        Variances of the noise of each coordinate [m^2] and of the heading [rad^2].
    groups
        Samples of the poses in consecutive windows, which are so long that the noise of their means has a small effect.
    """

    record: Record
    heading: FloatArray
    position: AnyArray
    turn: FloatArray
    noise: tuple[float, float]
    groups: list[AnyArray]

    @classmethod
    def create(cls, record: Record, predicted: FloatArray, yaw_rates: FloatArray) -> _PoseErrors | None:
        """Compare poses with predicted twists (K, 3) and yaw rates (K,); return None for too few poses."""
        assert record.pose is not None and record.fresh_pose is not None
        dt, fresh = record.dt, record.fresh_pose
        if np.count_nonzero(fresh) < _MIN_POSES:
            return None
        integrated_turn = dt * np.cumsum(_middle(yaw_rates))
        half = round(identification_settings().pose_window / dt)
        offset = np.where(fresh, record.pose[:, 2] - integrated_turn, 0.0)
        window = np.ones(2 * half + 1)
        weight = np.maximum(np.convolve(fresh, window, "same"), 1.0)
        heading = integrated_turn + np.convolve(offset, window, "same") / weight
        # The motion between two samples has the mean velocity and heading of the body.
        traction = np.gradient(predicted[:, 0], dt) * np.abs(predicted[:, 2])
        speeds = _middle(np.column_stack([predicted[:, 0] + 1j * predicted[:, 1], traction]))
        paths = dt * np.cumsum(speeds * np.exp(1j * _middle(heading))[:, None], axis=0)
        paths[:, 0] = record.pose[:, 0] + 1j * record.pose[:, 1] - paths[:, 0]
        turn = record.pose[:, 2] - dt * np.cumsum(_middle(predicted[:, 2]))
        # Second differences of smooth motion are negligible, so second differences of the errors are noise, with six
        # times its variance.
        noise = [np.mean(np.abs(np.diff(error[fresh], 2)) ** 2) / 6.0 for error in (paths[:, 0], turn)]
        noise[0] /= 2.0
        steps = max(half, round(math.sqrt(2.0 * noise[0]) / trial_settings().noise_speed / dt), 1)
        poses = np.flatnonzero(fresh)
        groups = np.split(poses, np.flatnonzero(np.diff(poses // steps)) + 1)
        return None if len(groups) < _MIN_POSES else cls(record, heading, paths, turn, (noise[0], noise[1]), groups)

    @property
    def _centres(self) -> AnyArray:
        """Central samples of the groups."""
        return np.array([round(group.mean()) for group in self.groups])

    @property
    def fast(self) -> FloatArray:
        """Forward deviations (N, 2) of `position` at single poses from the lines between the means of the groups."""
        assert self.record.fresh_pose is not None
        samples = np.flatnonzero(self.record.fresh_pose)
        samples = samples[(samples >= self._centres[0]) & (samples < self._centres[-1])]
        means = np.array([self.position[group].mean(axis=0) for group in self.groups])
        slow = np.column_stack([np.interp(samples, self._centres, column) for column in means.T])
        return ((self.position[samples] - slow) * np.exp(-1j * self.heading[samples])[:, None]).real

    def twists(self, traction_slip: float) -> FloatArray:
        """Compute twists (K, 3) of the displacements between the means of consecutive groups.

        The power of the noise of the means is subtracted.
        """
        starts, ends = self._centres[:-1], self._centres[1:]
        means = np.array([self.position[group].mean(axis=0) for group in self.groups]) @ [1.0, traction_slip]
        displacement = np.diff(means) * np.exp(-1j * self.heading[(starts + ends) // 2])
        turns = np.diff([self.turn[group].mean() for group in self.groups])
        windows = np.column_stack([displacement.real, displacement.imag, turns])
        power = np.maximum((windows**2).mean(axis=0), np.finfo(float).tiny)
        noise_share = 2.0 * np.mean([1.0 / len(group) for group in self.groups])
        windows *= np.sqrt(np.maximum(1.0 - noise_share * np.array(self.noise)[[0, 0, 1]] / power, 0.0))
        errors = np.zeros((len(self.heading), 3))
        rates = windows / (self.record.dt * (ends - starts))[:, None]
        errors[starts[0] : ends[-1]] = np.repeat(rates, ends - starts, axis=0)
        return errors
