"""The slip law of a floor from a drive: P4's nine coefficients by least squares, and how well each is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.slip_laws import POLYNOMIAL

_LEAST_ROWS = 30
# Terms with a higher correlation than this cannot be separated.
_ALIKE = 1e4


class IdentifiedSlip(NamedTuple):
    """Identified slip law."""

    coefficients: FloatArray
    """(3, 3) a11 to a33 of `models.slip_laws.polynomial_twist`, lateral to the left"""
    deviations: FloatArray
    """(3, 3) standard deviation of each; consecutive rows are weighted by their new information"""
    rms: FloatArray
    """(3,) residuals of forward speed, lateral speed [m/s] and yaw rate [rad/s]"""
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
    """Identify the nine coefficients from commands to the twist of the body; Ordonez et al., 2017 (P4), section 2.2.

    Each row of the law is linear in its three coefficients, so this is least squares in closed form, where P4 runs a
    Kalman filter on poses.

    Parameters
    ----------
    commands
        (n, 2) v [m/s], omega [rad/s] in order of time.
    twist
        (n, 3) forward speed, lateral speed to the left [m/s] and yaw rate [rad/s] of the body.
    sample_time
        Between two rows [s]; needed for `settling` alone.
    settling
        Time after a change of the command in which rows are left out: the robot is not there yet [s].
    used
        (n,) of bool: which rows to use; by default all. Rows that are not finite are left out in any case.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the shapes do not fit, too few rows are left, or the drive does not separate the coefficients.
    """
    rows, body = np.asarray(commands, dtype=float), np.asarray(twist, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or body.shape != (len(rows), 3):
        raise ConfigError(f"commands of shape {rows.shape} and twists of {body.shape}: give (n, 2) and (n, 3)")
    if settling > 0 and not sample_time > 0:
        raise ConfigError(f"sample time {sample_time} s: give a positive number, or no settling")
    keep = np.isfinite(rows).all(axis=1) & np.isfinite(body).all(axis=1)
    if used is not None:
        keep &= np.asarray(used, dtype=bool)
    if settling > 0:
        changed = np.concatenate([[True], (np.abs(np.diff(rows, axis=0)) > 1e-9).any(axis=1)])
        index = np.arange(len(rows))
        keep &= (index - np.maximum.accumulate(np.where(changed, index, 0))) * sample_time >= settling
    if keep.sum() < _LEAST_ROWS:
        raise ConfigError(
            f"{keep.sum()} samples determine the slip: give {_LEAST_ROWS} or more in which the robot drives"
        )
    v, omega = rows[keep].T
    terms = np.stack([v, omega, v * omega], axis=-1)
    scale = np.linalg.norm(terms, axis=0)
    if (scale == 0).any() or np.linalg.cond(terms / scale) > _ALIKE:
        raise ConfigError(
            "the drive does not separate the slip coefficients: drive turns to both sides at two speeds or more"
        )
    missing = body[keep] - np.stack([v, np.zeros_like(v), omega], axis=-1)
    solution, *_ = np.linalg.lstsq(terms / scale, missing, rcond=None)
    rest = missing - terms / scale @ solution
    inverse = np.linalg.inv((terms / scale).T @ (terms / scale))
    variance = (rest**2).sum(axis=0) / (len(v) - 3) * _repeats(rest)
    deviations = np.sqrt(np.outer(variance, np.diag(inverse))) / scale
    return IdentifiedSlip((solution.T / scale), deviations, np.sqrt(np.mean(rest**2, axis=0)), len(v))


def body_twists(before: FloatArray, after: FloatArray, time: float) -> FloatArray:
    """Compute forward, lateral speed [m/s] and yaw rate [rad/s] (n, 3) between poses (n, 3) in `time` [s]."""
    moved = after - before
    turn = np.arctan2(np.sin(moved[:, 2]), np.cos(moved[:, 2]))
    middle = before[:, 2] + 0.5 * turn
    # The chord of an arc, over how much shorter it is than the arc.
    shorter = np.sinc(0.5 * turn / np.pi) * time
    forward = (np.cos(middle) * moved[:, 0] + np.sin(middle) * moved[:, 1]) / shorter
    lateral = (-np.sin(middle) * moved[:, 0] + np.cos(middle) * moved[:, 1]) / shorter
    return np.stack([forward, lateral, turn / time], axis=-1)


def _repeats(rest: FloatArray) -> FloatArray:
    """Compute the number (3,) of rows with the information of one, from the correlation of residuals."""
    power = np.maximum((rest**2).sum(axis=0), np.finfo(float).tiny)
    alike = np.clip((rest[1:] * rest[:-1]).sum(axis=0) / power, 0.0, 0.999)
    return np.asarray((1 + alike) / (1 - alike))
