"""Mount and delay of a pose sensor, and the distance travelled per encoder distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate, join_estimates
from diffdrive_mpc.models.output_error.statistics import sandwich

_MIN_WINDOWS = 20
_DELAY_STEP = 0.2
"""Grid step of the search for the delay, as a share of the sample time."""


class _Window(NamedTuple):
    """Displacement between two poses, and its regressors."""

    regressors: FloatArray
    """Regressors (2, 4): travel along and across the sensor's heading, lever arm ahead and to the left."""
    displacement: FloatArray
    """Displacement (2,) [m], in the sensor frame at the start."""


def pose_sensor(records: Sequence[Record], point: Mapping[str, float]) -> ParameterEstimate | None:
    """Identify pose.delay [s], pose.travel [-], mount.ahead, mount.left [m] and mount.heading [rad].

    The delay relative to the gyro minimises the difference between the headings and the integrated gyro. Displacements
    over short windows are then regressed on two terms: the distance of the encoders along the measured heading
    (`pose.travel` metres per metre, rotated by `mount.heading`), and the rotation of the sensor about the centre of
    rotation. `mount.ahead` includes side-slip proportional to the yaw rate, because the data cannot separate both. The
    result is None for too few poses.

    Parameters
    ----------
    records
        Records, of which some have poses.
    point
        Parameters estimated from encoders and gyro; see `fit_effects`.
    """
    records_with_pose = [record for record in records if record.pose is not None]
    delay = _find_delay(records_with_pose, point) if records_with_pose else None
    if delay is None:
        return None
    windows = [window for record in records_with_pose for window in _collect_windows(record, point, delay)]
    if len(windows) < _MIN_WINDOWS:
        return None
    regressors = np.array([window.regressors for window in windows])
    displacement = np.array([window.displacement for window in windows])
    inlier = np.ones(len(windows), dtype=bool)
    for _ in range(3):
        solution = np.linalg.lstsq(regressors[inlier].reshape(-1, 4), displacement[inlier].ravel(), rcond=None)[0]
        error = regressors @ solution - displacement
        inlier = np.hypot(*error.T) < effect_settings().pose.outlier
    scale = float(np.sqrt(np.mean(error[inlier] ** 2)))
    spread = sandwich([regressors[inlier] / scale], [error[inlier] / scale]).covariance
    linear = ParameterEstimate(("along", "across", "mount.ahead", "mount.left"), solution, spread)
    mount = linear.derived(
        ("pose.travel", "mount.heading", "mount.ahead", "mount.left"),
        lambda row: np.array([np.hypot(row[0], row[1]), np.arctan2(row[1], row[0]), row[2], row[3]]),
    )
    # The standard deviation of the delay follows from the grid step.
    sd = _DELAY_STEP * records_with_pose[0].dt / np.sqrt(12.0)
    return join_estimates([ParameterEstimate(("pose.delay",), np.array([delay]), np.array([[sd**2]])), mount])


def _find_delay(records: Sequence[Record], point: Mapping[str, float]) -> float | None:
    """Find the delay [s] at which heading changes over one second agree best with the gyro."""
    low, high = effect_settings().pose.delays
    best: tuple[float, float] | None = None
    for delay in np.arange(low, high, _DELAY_STEP * records[0].dt):
        errors = []
        for record in records:
            if record.yaw_rate is None or record.pose is None or record.fresh_pose is None:
                continue
            is_valid = np.isfinite(record.yaw_rate)
            rate = np.interp(record.time, record.time[is_valid], record.yaw_rate[is_valid] - point["gyro.offset"])
            turn = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * record.dt)])
            error = record.pose[:, 2] - np.interp(record.time - delay, record.time, turn)
            second = round(1.0 / record.dt)
            are_fresh = record.fresh_pose[second:] & record.fresh_pose[:-second]
            errors.append(np.abs(error[second:] - error[:-second])[are_fresh])
        pooled = np.concatenate(errors) if errors else np.empty(0)
        if len(pooled) < _MIN_WINDOWS:
            return None
        mean_error = float(np.mean(pooled))
        if best is None or mean_error < best[0]:
            best = (mean_error, float(delay))
    return best[1] if best else None


def _collect_windows(record: Record, point: Mapping[str, float], delay: float) -> list[_Window]:
    """Collect the displacements between new poses, in windows without overlap."""
    if record.twist is None or record.pose is None:
        return []
    steps = round(effect_settings().pose.window / record.dt)
    encoder_delay = point["encoders.delay"] + point.get("encoders.lag", 0.0)
    is_valid = np.isfinite(record.twist[:, 0])
    if not is_valid.any():
        return []
    speed = np.interp(record.time - delay + encoder_delay, record.time[is_valid], record.twist[is_valid, 0])
    x, y, theta = record.pose.T
    c, s = np.cos(theta), np.sin(theta)
    windows = []
    for k in record.pose_windows(steps, np.isfinite(theta)):
        rows = slice(k, k + steps + 1)
        travel = np.array([_trapezoid(speed[rows] * c[rows]), _trapezoid(speed[rows] * s[rows])]) * record.dt
        to_sensor = np.array([[c[k], s[k]], [-s[k], c[k]]])
        turn = theta[k + steps] - theta[k]
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        along = to_sensor @ travel
        across = np.array([-along[1], along[0]])
        displacement = to_sensor @ np.array([x[k + steps] - x[k], y[k + steps] - y[k]])
        windows.append(_Window(np.column_stack([along, across, rotation - np.eye(2)]), displacement))
    return windows


def _trapezoid(values: FloatArray) -> float:
    return float(np.sum(values[1:] + values[:-1]) / 2)
