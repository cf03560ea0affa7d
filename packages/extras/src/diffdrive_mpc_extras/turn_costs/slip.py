"""Identification of a slip law from a drive: nine coefficients with standard deviations, by least squares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.slip_laws import POLYNOMIAL

_MIN_ROWS = 30
_MAX_CONDITION = 1e4
"""Condition number of the terms above which the coefficients cannot be separated."""


class IdentifiedSlip(NamedTuple):
    """Identified slip law."""

    coefficients: FloatArray
    """Coefficients (3, 3): a11 to a33 of `models.slip_laws.polynomial_twist`, lateral to the left"""
    deviations: FloatArray
    """Standard deviations (3, 3) of the coefficients, corrected for correlated residuals"""
    rms: FloatArray
    """RMS residuals (3,) of forward speed, lateral speed [m/s] and yaw rate [rad/s]"""
    rows: int
    """Number of samples used."""

    def named(self) -> dict[str, float]:
        """Return the coefficients by name."""
        return dict(zip(POLYNOMIAL, self.coefficients.ravel().tolist(), strict=True))


def identify_slip(
    commands: ArrayLike,
    twist: ArrayLike,
    sample_time: float = 0.0,
    settling: float = 0.0,
    used: ArrayLike | None = None,
) -> IdentifiedSlip:
    """Identify the nine coefficients of the slip law from commands and body twists.

    Source of the law: Ordonez et al., 2017 (P4), section 2.2. Each row of the law is linear in its three coefficients,
    so linear least squares is sufficient; P4 uses a Kalman filter on poses.

    Parameters
    ----------
    commands
        (n, 2) v [m/s], omega [rad/s] in order of time.
    twist
        (n, 3) forward speed, lateral speed to the left [m/s] and yaw rate [rad/s] of the body.
    sample_time
        Time between two rows [s]; required for `settling` only.
    settling
        Settling time after a change of the command; rows in this time are omitted [s].
    used
        (n,) booleans that select rows; by default all rows. Rows that are not finite are always omitted.

    Raises
    ------
    models.checked_yaml.ConfigError
        If shapes do not match, too few rows remain, or the drive does not separate the coefficients.
    """
    rows, body = np.asarray(commands, dtype=float), np.asarray(twist, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or body.shape != (len(rows), 3):
        raise ConfigError(f"commands of shape {rows.shape} and twists of {body.shape}: use (n, 2) and (n, 3)")
    if settling > 0 and not sample_time > 0:
        raise ConfigError(f"sample time {sample_time} s: use a positive number, or no settling")
    valid = np.isfinite(rows).all(axis=1) & np.isfinite(body).all(axis=1)
    if used is not None:
        valid &= np.asarray(used, dtype=bool)
    if settling > 0:
        changed = np.concatenate([[True], (np.abs(np.diff(rows, axis=0)) > 1e-9).any(axis=1)])
        index = np.arange(len(rows))
        valid &= (index - np.maximum.accumulate(np.where(changed, index, 0))) * sample_time >= settling
    if valid.sum() < _MIN_ROWS:
        raise ConfigError(
            f"only {valid.sum()} samples remain for the slip law: provide at least {_MIN_ROWS} of a moving robot"
        )
    v, omega = rows[valid].T
    terms = np.stack([v, omega, v * omega], axis=-1)
    scale = np.linalg.norm(terms, axis=0)
    if (scale == 0).any() or np.linalg.cond(terms / scale) > _MAX_CONDITION:
        raise ConfigError(
            "the drive does not separate the slip coefficients: drive turns to both sides at two speeds or more"
        )
    slip = body[valid] - np.stack([v, np.zeros_like(v), omega], axis=-1)
    solution, *_ = np.linalg.lstsq(terms / scale, slip, rcond=None)
    residuals = slip - terms / scale @ solution
    inverse = np.linalg.inv((terms / scale).T @ (terms / scale))
    variance = (residuals**2).sum(axis=0) / (len(v) - 3) * _variance_inflation(residuals)
    deviations = np.sqrt(np.outer(variance, np.diag(inverse))) / scale
    return IdentifiedSlip((solution.T / scale), deviations, np.sqrt(np.mean(residuals**2, axis=0)), len(v))


def body_twists(start: FloatArray, end: FloatArray, time: float) -> FloatArray:
    """Compute mean twists (n, 3) between poses (n, 3) that are `time` [s] apart.

    The columns are forward speed, lateral speed [m/s] and yaw rate [rad/s].
    """
    change = end - start
    turn = np.arctan2(np.sin(change[:, 2]), np.cos(change[:, 2]))
    heading = start[:, 2] + 0.5 * turn
    # The chord of an arc is shorter than the arc by the factor sinc.
    divisor = np.sinc(0.5 * turn / np.pi) * time
    forward = (np.cos(heading) * change[:, 0] + np.sin(heading) * change[:, 1]) / divisor
    lateral = (-np.sin(heading) * change[:, 0] + np.cos(heading) * change[:, 1]) / divisor
    return np.stack([forward, lateral, turn / time], axis=-1)


def _variance_inflation(residuals: FloatArray) -> FloatArray:
    """Compute the factor (3,) on the variance from the correlation of consecutive residuals."""
    power = np.maximum((residuals**2).sum(axis=0), np.finfo(float).tiny)
    correlation = np.clip((residuals[1:] * residuals[:-1]).sum(axis=0) / power, 0.0, 0.999)
    return np.asarray((1 + correlation) / (1 - correlation))
