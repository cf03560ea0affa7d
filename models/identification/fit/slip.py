"""Side-slip of a skid-steered robot from the poses of a log, as initial values of the controller's filter.

The lateral speed to the left is -side_slip v omega + load_shift a omega, with the forward acceleration a (see
`mpc/problem/formulas.py`). Mean lateral speeds over short windows are regressed on the means of both terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.statistics import sandwich

NAMES = ("side_slip", "load_shift")
"""Names of the slip parameters [s, s^2]."""

_MIN_WINDOWS = 8
_MIN_POSES = 3


class SlipPrior(NamedTuple):
    """Initial slip estimate of the controller's filter."""

    estimate: ParameterEstimate
    """Estimate of the parameters `NAMES`; the covariance includes the spread between surfaces."""
    is_regressed: bool
    """True if the log reduces the standard deviation of side_slip to less than half of its prior value."""

    def source(self) -> str:
        """Describe the source of the values for comments in the configuration."""
        if self.is_regressed:
            return "regressed from the poses of the log"
        return "a wide prior, because the log has too few or too noisy poses"

    def __str__(self) -> str:
        """Format the estimate as one line of the report."""
        values = (f"{name} {value:.3f} ± {sd:.3f}" for name, value, sd in self.estimate.rows)
        return f"The filter starts with {' s and '.join(values)} s^2: {self.source()}."


def slip_prior(records: Sequence[Record]) -> SlipPrior:
    """Update the prior of the settings with the slip estimate from `records` with poses of the rotation centre."""
    settings, estimate = identification_settings().slip, lateral_slip(records)
    mean, deviation, surfaces = (
        np.array([row[k] for row in (settings.side_slip, settings.load_shift)]) for k in range(3)
    )
    covariance = np.diag(deviation**2)
    if estimate is not None:
        gain = covariance @ np.linalg.inv(covariance + estimate.covariance + np.diag(surfaces**2))
        # The configuration requires an initial value of at least 0; the filter can still learn inward slip.
        mean = np.maximum(mean + gain @ (estimate.values - mean), 0.0)
        covariance = covariance - gain @ covariance
    return SlipPrior(ParameterEstimate(NAMES, mean, covariance), bool(covariance[0, 0] < (0.5 * deviation[0]) ** 2))


def lateral_slip(records: Sequence[Record]) -> ParameterEstimate | None:
    """Estimate the parameters `NAMES`; return None if encoders are missing or if there are too few poses or turns."""
    table = np.array([window for record in records for window in _window_means(record)])
    if len(table) < _MIN_WINDOWS:
        return None
    terms, lateral_speed = table[:, :2], table[:, 2]
    values, _, rank, _ = np.linalg.lstsq(terms, lateral_speed, rcond=None)
    if rank < len(NAMES):
        return None
    residual = lateral_speed - terms @ values
    scale = float(np.sqrt(np.mean(residual**2))) + np.finfo(float).tiny
    covariance = sandwich([terms[:, None, :] / scale], [residual[:, None] / scale]).covariance
    return ParameterEstimate(NAMES, values, covariance)


def _window_means(record: Record) -> list[FloatArray]:
    """Compute the means (3,) over each window: -v omega [m/s^2], a omega [m/s^3] and speed to the left [m/s]."""
    dt, span = record.dt, max(2, round(identification_settings().pose_window / record.dt))
    if record.pose is None or record.twist is None or record.fresh_pose is None or len(record.pose) <= span:
        return []
    v, omega = record.twist[:, 0], _scaled_yaw_rate(record)
    terms = np.column_stack([-v * omega, np.gradient(v, dt) * omega])
    windows = []
    for first in range(0, len(v) - span, span):
        part = slice(first, first + span + 1)
        fresh, pose = record.fresh_pose[part], record.pose[part]
        if fresh.sum() < _MIN_POSES or not (np.isfinite(terms[part]).all() and np.isfinite(v[part]).all()):
            continue
        # The integrated yaw rate, aligned with all poses of the window, has less noise than the headings of the poses.
        rotation = _integrate(omega[part], dt)
        theta = rotation + float(np.mean((pose[:, 2] - rotation)[fresh]))
        left = np.column_stack([-np.sin(theta), np.cos(theta)])
        forward = np.column_stack([np.cos(theta), np.sin(theta)])
        # Least-squares slope over time, in the lateral direction at the middle, because the window rotates little.
        time = np.flatnonzero(fresh) - np.mean(np.flatnonzero(fresh))
        slope = time / (dt * time @ time)
        paths = [_integrate(terms[part, k, None] * left, dt) for k in range(2)]
        paths.append(pose[:, :2] - _integrate(v[part, None] * forward, dt))
        windows.append(np.array([slope @ path[fresh] @ left[len(left) // 2] for path in paths]))
    return windows


def _scaled_yaw_rate(record: Record) -> FloatArray:
    """Return the yaw rate (K,) [rad/s] of the gyro, or of the encoders, scaled to fit the poses, without a gyro."""
    if record.yaw_rate is not None:
        return record.yaw_rate
    assert record.twist is not None and record.pose is not None
    wheels = record.twist[:, 1]
    rotation = record.dt * np.cumsum(np.nan_to_num(wheels))[record.fresh_pose]
    rotation -= rotation.mean()
    scale = (rotation @ record.pose[record.fresh_pose, 2]) / (rotation @ rotation + np.finfo(float).tiny)
    return np.asarray(wheels * scale)


def _integrate(rows: FloatArray, dt: float) -> FloatArray:
    """Integrate `rows` (K, ...) by the trapezoidal rule, starting with zero."""
    steps = 0.5 * dt * (rows[1:] + rows[:-1])
    return np.asarray(np.concatenate([np.zeros_like(rows[:1]), np.cumsum(steps, axis=0)]))


# Surface parameters from gyro and encoders of a log, for a simulated plant of the robot.


SURFACE_FILE = "surface.yaml"


def log_surface(records: Sequence[Record], prior: SlipPrior) -> dict[str, dict[str, float]]:
    """Return keys and values of a surface file: ratio of body and encoder yaw rate, and side-slip.

    Without a gyro, the model's omega is that of the encoders, and the ratio is 1. Side-slip is that of `prior`.
    """
    pairs = [
        (record.yaw_rate[is_valid], record.twist[is_valid, 1])
        for record in records
        if record.yaw_rate is not None and record.twist is not None
        for is_valid in [np.isfinite(record.yaw_rate) & np.isfinite(record.twist[:, 1])]
    ]
    ratio = 1.0
    if pairs:
        body, wheels = (np.concatenate(values) for values in zip(*pairs, strict=True))
        ratio = float(body @ wheels / (wheels @ wheels))
    slip = {"yaw_gain": 1.0, "wheel_yaw_gain": float(f"{ratio:.4g}"), "longitudinal_gain": 1.0}
    return {"slip": slip | {"side_slip": float(f"{prior.estimate.value('side_slip'):.4g}")}}


def surface_text(surface: Mapping[str, Mapping[str, float]]) -> str:
    """Format the surface file, with a comment for each value."""
    reasons = {
        "yaw_gain": "ratio of true yaw rate and the model's; 1, because the model is identified from the log",
        "wheel_yaw_gain": "ratio of true yaw rate and the encoders', from the gyro; 1 for a log without a gyro",
        "longitudinal_gain": "ratio of true forward speed and the encoders'; assumed, robot.yaml has that of the poses",
        "side_slip": "s, ratio of lateral speed and v * omega; see config.yaml",
    }
    lines = [f"  {name}: {value}   # {reasons[name]}" for name, value in surface["slip"].items()]
    return "\n".join(["# Surface of the log, for `simulate --surface` with a model: plant.", "slip:", *lines]) + "\n"
