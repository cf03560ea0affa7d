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
_NOISE_BOUND = 2.27
"""Upper 95 % bound of the error of a variance after subtraction of white noise, as a multiple of the power of the noise
over the square root of the number of poses: 1.645 times the square root of 1.9.

The noise power is estimated from second differences. They multiply the variance of that estimate by 35 / 18.
"""
_MIN_VARIANCE = 0.1
"""Minimum constant variance as a share of the mean variance [-], because logs have little straight, steady motion."""
_HEADER = (
    "# Robot of the log, for `--plant model:FILE`, `predict-error` and `prove`: model, surface, sensors, and\n"
    "# unexplained motion with its variance by speeds and rates, and intervals of samples and multiples of its\n"
    "# deviation.\n"
)


def unexplained_motion(identification: Identification) -> tuple[list[FloatArray], float, float, bool]:
    """Compute measured minus predicted twists (K, 3) of each validation record, traction slip, and fast displacement.

    The last result is True if poses determine the twists of any record.

    The twists are means over windows. The columns are forward and lateral speed [m/s] and yaw rate [rad/s] of the
    rotation centre on the surface of the log. Measured twists are computed from poses, except for yaw rates of a gyro.
    For records without poses they are those of encoders and gyro, with zero lateral speed.

    The traction slip c [s^2/rad] is fitted to all poses; the prediction includes the slip c |omega| dv/dt. The fast
    displacement [m] is the standard deviation of single poses, without their noise, from the motion between the means;
    it includes the part that the noise can hide.
    """
    report = identification.report
    slip, load_shift = log_slip(identification), identification.config["estimator"]["load_shift"]
    motion, by_pose = [], []
    for record, outputs in zip(report.data.validation, report.fitted.simulated, strict=True):
        assert record.twist is not None
        yaw_rate = record.yaw_rate if report.data.yaw == "gyro" else None
        speeds = [record.twist[:, 0], record.twist[:, 1] if yaw_rate is None else yaw_rate] - outputs.T
        errors = np.nan_to_num(np.column_stack([speeds[0], np.zeros(len(outputs)), speeds[1]]))
        motion.append(_block_means(errors, trial_settings().window / record.dt))
        if yaw_rate is not None:
            motion[-1][:, 2] = _block_means(errors[:, 2], _GYRO_WINDOW / record.dt)
        if record.fresh_pose is not None and np.count_nonzero(record.fresh_pose) >= _MIN_POSES:
            predicted = slip.body((outputs - report.fitted.offset).T).T
            predicted[:, 1] += load_shift * np.gradient(predicted[:, 0], record.dt) * predicted[:, 2]
            yaw_rates = predicted[:, 2] if yaw_rate is None else np.nan_to_num(yaw_rate - report.fitted.offset[1])
            if part := _PoseErrors.create(report.poses.at_rotation_centre([record])[0], predicted, yaw_rates):
                by_pose.append((part, motion[-1][:, : 3 if yaw_rate is None else 2]))
    if not by_pose:
        return motion, 0.0, 0.0, False
    fast, slipped, noise = np.concatenate([part.fast() for part, _ in by_pose]).T
    traction_slip = max(0.0, float(-(fast @ slipped) / max(slipped @ slipped, np.finfo(float).tiny)))
    for part, columns in by_pose:
        columns[:] = part.twists(traction_slip)[:, : columns.shape[1]]
    variance = max(0.0, float(np.mean((fast + traction_slip * slipped) ** 2 - noise)))
    displacement = math.sqrt(variance + _NOISE_BOUND * math.sqrt(np.mean(noise**2) / len(noise)))
    return motion, traction_slip, displacement, True


def identified_robot(identification: Identification, config: ControllerConfig) -> IdentifiedRobot | None:
    """Build the robot of the log, with sensors like those of the log, for simulations; None if no motion is known.

    The variance of the unexplained motion is a non-negative linear function of squared speeds and rates. Iteratively
    weighted least squares converge to maximum likelihood, so that large errors do not determine small variances.
    """
    report = identification.report
    motion, traction_slip, displacement, has_poses = unexplained_motion(identification)
    if not any(map(len, motion)):
        return None
    identified, dt = report.fitted.identified, report.data.validation[0].dt
    deviations = _deviations(identified.parameters, ("{0}.gain", "gain.{0}_ref_to_{0}"))
    outputs = [np.nan_to_num(rows - report.fitted.offset) for rows in report.fitted.simulated]
    slip, deviation = _subtract_slip(motion, outputs, identification)
    window = trial_settings().window / dt
    yaw_slip = _subtract_yaw_slip(motion, outputs, _GYRO_WINDOW / dt if report.data.yaw == "gyro" else window)
    features = [_block_means(intensity_features(rows, np.gradient(rows, dt, axis=0)), window) for rows in outputs]
    all_features, errors = np.concatenate(features), np.concatenate(motion)
    # Only poses show motion at rest. Without them a constant variance would make a robot creep that stands still.
    fitted_features = all_features * [has_poses, 1.0, 1.0, 1.0, 1.0, 1.0]
    variance = np.array([_fit_variance(fitted_features, column**2) for column in errors.T])
    minimum = _MIN_VARIANCE * (errors**2).mean(axis=0) + np.finfo(float).eps
    variance[:, 0] = np.maximum(variance[:, 0], has_poses * minimum)
    normalised = [row / np.sqrt((rows @ variance.T).clip(minimum)) for row, rows in zip(motion, features, strict=True)]
    return IdentifiedRobot(
        model=MODEL_FILE,
        slip=slip,
        sensors=log_sensors(identification, config),
        sample_time=dt,
        block_time=identification_settings().block_time,
        gain_deviation=(deviations[0] if deviation is None else deviation, deviations[1]),
        delay_deviation=_deviations(identified.delays, ("{0}.sum",)),
        variance=_round_values(variance),
        traction_slip=float(f"{traction_slip:.4g}"),
        yaw_slip=_round_values(yaw_slip),
        on_wheels=(not has_poses, not has_poses and report.data.yaw != "gyro"),
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
    records = zip(motion, outputs, validation, strict=True)
    pairs = [(errors, twist) for errors, twist, record in records if record.pose is not None]
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


def _subtract_yaw_slip(motion: list[FloatArray], outputs: Sequence[FloatArray], window: float) -> FloatArray:
    """Fit yaw rates in proportion to omega and v^2 omega (2,), and subtract them from `motion`.

    Wheels that skid turn the body less on the spot than at speed, and motors lose speed in fast turns. A model with
    constant gains does not predict this, but each drive repeats it. `window` is the number of samples of a mean.
    """
    terms = [_block_means(rows[:, 1:] * rows[:, :1] ** [0, 2], window) for rows in outputs]
    yaw_slip = np.linalg.lstsq(np.concatenate(terms), np.concatenate(motion)[:, 2])[0]
    for errors, columns in zip(motion, terms, strict=True):
        errors[:, 2] -= columns @ yaw_slip
    return np.asarray(yaw_slip)


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
    # robot.yaml has the key only if it is true.
    content = robot.model_dump(mode="json", exclude=None if any(robot.on_wheels) else {"on_wheels"})
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    path.write_text(f"{_HEADER}{text}", encoding="utf-8")


def _fit_variance(features: FloatArray, squares: FloatArray) -> FloatArray:
    """Fit non-negative coefficients of features (K, 6) to squares (K,) of normal errors."""
    mean = variance = np.array([max(squares.mean(), np.finfo(float).eps)])
    for _ in range(20):
        coefficients = nnls(features / variance[:, None], squares / variance)[0]
        variance = np.maximum(features @ coefficients, _MIN_VARIANCE * mean)
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
    dt
        Sample time [s].
    heading
        (K,) heading [rad]: the integral of the yaw rates, aligned with the poses in a moving window, because it has
        less noise than single poses.
    errors
        (K, 3) complex: measured minus predicted position [m], change of position per traction slip [m rad/s^2], and
        measured minus predicted heading [rad].
    noise
        (2,) variances of the noise of a coordinate [m^2] and of the heading [rad^2].
    groups
        Samples of the poses in consecutive windows, which are so long that the noise of their means has a small effect.
    centres, means
        (n,) central samples of the groups, and (n, 3) means of `errors`.
    """

    dt: float
    heading: FloatArray
    errors: AnyArray
    noise: FloatArray
    groups: list[AnyArray]
    centres: AnyArray
    means: AnyArray

    @classmethod
    def create(cls, record: Record, predicted: FloatArray, yaw_rates: FloatArray) -> _PoseErrors | None:
        """Compare poses with predicted twists (K, 3) and yaw rates (K,); return None for too few groups."""
        assert record.pose is not None and record.fresh_pose is not None
        dt, fresh = record.dt, record.fresh_pose
        integrated_turn = dt * np.cumsum(_middle(yaw_rates))
        half = round(identification_settings().pose_window / dt)
        offset = np.where(fresh, record.pose[:, 2] - integrated_turn, 0.0)
        window = np.ones(2 * min(half, (len(fresh) - 1) // 2) + 1)  # not longer than a short stretch
        total, count = (np.convolve(values, window, "same") for values in (offset, fresh))
        heading = integrated_turn + total / np.maximum(count, 1.0)
        # The motion between two samples has the mean velocity and heading of the body.
        traction = np.gradient(predicted[:, 0], dt) * np.abs(predicted[:, 2])
        speeds = _middle(np.column_stack([predicted[:, 0] + 1j * predicted[:, 1], traction, predicted[:, 2]]))
        directions = np.exp(1j * _middle(np.column_stack([heading, heading, np.zeros(len(heading))])))
        errors = dt * np.cumsum(speeds * directions, axis=0)
        errors[:, [0, 2]] = record.pose @ [[1, 0], [1j, 0], [0, 1]] - errors[:, [0, 2]]
        # Second differences of smooth motion are negligible, so second differences of the errors are noise, with six
        # times its variance; a position has two coordinates.
        noise = np.mean(np.abs(np.diff(errors[fresh][:, [0, 2]], 2, axis=0)) ** 2, axis=0) / [12.0, 6.0]
        steps = max(half, round(math.sqrt(2.0 * noise[0]) / trial_settings().noise_speed / dt), 1)
        poses = np.flatnonzero(fresh)
        groups = np.split(poses, np.flatnonzero(np.diff(poses // steps)) + 1)
        centres = np.array([round(group.mean()) for group in groups])
        means = np.array([errors[group].mean(axis=0) for group in groups])
        return cls(dt, heading, errors, noise, groups, centres, means) if len(groups) >= _MIN_POSES else None

    def fast(self) -> FloatArray:
        """Return forward deviations of `errors` at N poses from lines between the means, and noise variance (N, 3)."""
        poses = np.concatenate(self.groups)
        poses = poses[(poses >= self.centres[0]) & (poses < self.centres[-1])]
        slow = np.column_stack([np.interp(poses, self.centres, column) for column in self.means[:, :2].T])
        forward = ((self.errors[poses, :2] - slow) * np.exp(-1j * self.heading[poses])[:, None]).real
        return np.column_stack([forward, np.full(len(poses), self.noise[0])])

    def twists(self, traction_slip: float) -> FloatArray:
        """Compute twists (K, 3) from differences of the means; the power of their noise is subtracted."""
        starts, ends = self.centres[:-1], self.centres[1:]
        displacement, turns = np.diff(self.means @ [[1.0, 0.0], [traction_slip, 0.0], [0.0, 1.0]], axis=0).T
        displacement = displacement * np.exp(-1j * self.heading[(starts + ends) // 2])
        windows = np.column_stack([displacement.real, displacement.imag, turns.real])
        power = np.maximum((windows**2).mean(axis=0), np.finfo(float).eps)
        noise_share = 2.0 * np.mean([1.0 / len(group) for group in self.groups])
        windows *= np.sqrt(np.maximum(1.0 - noise_share * self.noise[[0, 0, 1]] / power, 0.0))
        errors = np.zeros((len(self.heading), 3))
        errors[starts[0] : ends[-1]] = np.repeat(windows / (self.dt * (ends - starts))[:, None], ends - starts, axis=0)
        return errors
