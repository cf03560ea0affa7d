"""Side-slip of a skid-steer from the poses of a log: the values that the controller's filter begins with.

The lateral speed to the left is -side_slip v omega + load_shift a omega, a the forward acceleration (see
`mpc/problem/formulas.py`). Mean lateral speeds of short windows, from all their poses, are regressed on the means of
both terms.
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
"""[s], [s^2]."""

_FEWEST_WINDOWS = 8
_FEWEST_POSES = 3


class SlipPrior(NamedTuple):
    """Values that the controller's filter begins with."""

    estimate: ParameterEstimate
    """`NAMES`; the covariance includes the differences between surfaces."""
    is_regressed: bool
    """True if the log halves the deviation of side_slip; otherwise both are about those of the settings."""

    def source(self) -> str:
        """Return the origin of the values, as a comment of the configuration."""
        if self.is_regressed:
            return "regressed from the poses of the log"
        return "a wide prior, as the log has too few or too noisy poses"

    def __str__(self) -> str:
        """Return one line for the report."""
        values = (f"{name} {value:.3f} ± {sd:.3f}" for name, value, sd in self.estimate.rows)
        return f"The filter begins with {' s and '.join(values)} s^2: {self.source()}."


def slip_prior(records: Sequence[Record]) -> SlipPrior:
    """Update the Gaussian prior of the settings by `lateral_slip` of the records (poses of the rotation centre)."""
    settings, estimate = identification_settings().slip, lateral_slip(records)
    mean, wide, surfaces = (np.array([row[k] for row in (settings.side_slip, settings.load_shift)]) for k in range(3))
    covariance = np.diag(wide**2)
    if estimate is not None:
        gain = covariance @ np.linalg.inv(covariance + estimate.covariance + np.diag(surfaces**2))
        # Inward slip is left to the filter: its configuration allows no negative start.
        mean = np.maximum(mean + gain @ (estimate.values - mean), 0.0)
        covariance = covariance - gain @ covariance
    return SlipPrior(ParameterEstimate(NAMES, mean, covariance), bool(covariance[0, 0] < (0.5 * wide[0]) ** 2))


def lateral_slip(records: Sequence[Record]) -> ParameterEstimate | None:
    """Estimate `NAMES` with their covariance; None without encoders, or with too few poses or turns."""
    table = np.array([window for record in records for window in _windows(record)])
    if len(table) < _FEWEST_WINDOWS:
        return None
    terms, moved = table[:, :2], table[:, 2]
    values, _, rank, _ = np.linalg.lstsq(terms, moved, rcond=None)
    if rank < len(NAMES):
        return None
    left = moved - terms @ values
    scale = float(np.sqrt(np.mean(left**2))) + np.finfo(float).tiny
    covariance = sandwich([terms[:, None, :] / scale], [left[:, None] / scale]).covariance
    return ParameterEstimate(NAMES, values, covariance)


def _windows(record: Record) -> list[FloatArray]:
    """Return (3,) means of each window: -v omega [m/s^2], a omega [m/s^3] and speed to the left [m/s]."""
    dt, span = record.dt, max(2, round(identification_settings().pose_window / record.dt))
    if record.pose is None or record.twist is None or record.fresh_pose is None or len(record.pose) <= span:
        return []
    v, omega = record.twist[:, 0], _yaw_rate(record)
    terms = np.column_stack([-v * omega, np.gradient(v, dt) * omega])
    windows = []
    for first in range(0, len(v) - span, span):
        part = slice(first, first + span + 1)
        fresh, pose = record.fresh_pose[part], record.pose[part]
        if fresh.sum() < _FEWEST_POSES or not (np.isfinite(terms[part]).all() and np.isfinite(v[part]).all()):
            continue
        # Heading by the yaw rate, laid over all poses of a window: less noise than a single pose's.
        turned = _integral(omega[part], dt)
        theta = turned + float(np.mean((pose[:, 2] - turned)[fresh]))
        across = np.column_stack([-np.sin(theta), np.cos(theta)])
        ahead = np.column_stack([np.cos(theta), np.sin(theta)])
        # Slope over time by least squares. To the left at the middle: side-slip turns little in one window.
        time = np.flatnonzero(fresh) - np.mean(np.flatnonzero(fresh))
        slope = time / (dt * time @ time)
        ways = [_integral(terms[part, k, None] * across, dt) for k in range(2)]
        ways.append(pose[:, :2] - _integral(v[part, None] * ahead, dt))
        windows.append(np.array([slope @ way[fresh] @ across[len(across) // 2] for way in ways]))
    return windows


def _yaw_rate(record: Record) -> FloatArray:
    """Return (K,) of the gyro; without one that of the encoders, scaled to the turns of the poses [rad/s]."""
    if record.yaw_rate is not None:
        return record.yaw_rate
    assert record.twist is not None and record.pose is not None
    wheels = record.twist[:, 1]
    turned = record.dt * np.cumsum(np.nan_to_num(wheels))[record.fresh_pose]
    turned -= turned.mean()
    return np.asarray(wheels * (turned @ record.pose[record.fresh_pose, 2]) / (turned @ turned + np.finfo(float).tiny))


def _integral(rows: FloatArray, dt: float) -> FloatArray:
    """Integrate `rows` (K, ...) from the first one on by the trapezoidal rule."""
    steps = 0.5 * dt * (rows[1:] + rows[:-1])
    return np.asarray(np.concatenate([np.zeros_like(rows[:1]), np.cumsum(steps, axis=0)]))


# Surface of a log, as far as gyro and encoders determine it, for a model plant of the robot.


SURFACE_FILE = "surface.yaml"


def log_surface(records: Sequence[Record], prior: SlipPrior) -> dict[str, dict[str, float]]:
    """Return keys and values of a surface file: the yaw rate of the body over that of the encoders.

    Without a gyro the model's omega is that of the encoders, and the body is assumed to turn accordingly. Side-slip is
    that of `slip_prior`.
    """
    both = [
        (record.yaw_rate[used], record.twist[used, 1])
        for record in records
        if record.yaw_rate is not None and record.twist is not None
        for used in [np.isfinite(record.yaw_rate) & np.isfinite(record.twist[:, 1])]
    ]
    ratio = 1.0
    if both:
        body, wheels = (np.concatenate(values) for values in zip(*both, strict=True))
        ratio = float(body @ wheels / (wheels @ wheels))
    slip = {"yaw_gain": 1.0, "wheel_yaw_gain": float(f"{ratio:.4g}"), "longitudinal_gain": 1.0}
    return {"slip": slip | {"side_slip": float(f"{prior.estimate.value('side_slip'):.4g}")}}


def surface_text(surface: Mapping[str, Mapping[str, float]]) -> str:
    """Format the surface file, with a reason for each value."""
    reasons = {
        "yaw_gain": "true yaw rate over that of the model, which is the log's",
        "wheel_yaw_gain": "true yaw rate over that of the encoders, by the gyro of the log; 1 without one",
        "longitudinal_gain": "true forward speed over that of the encoders; not in the log",
        "side_slip": "s, lateral speed over v * omega; see config.yaml",
    }
    lines = [f"  {name}: {value}   # {reasons[name]}" for name, value in surface["slip"].items()]
    return "\n".join(["# Surface of the log, for `simulate --surface` with a model: plant.", "slip:", *lines]) + "\n"
