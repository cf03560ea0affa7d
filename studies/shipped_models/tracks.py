"""The tracks of a skid-steer, from speeds of its sides and yaw rates."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray


def side_difference(wheel_speeds: FloatArray, radius: float) -> FloatArray:
    """(K,) right minus left rim speed [m/s] of wheel speeds (K, 4) [rad/s]; each side is the mean of its wheels."""
    return np.asarray(0.5 * radius * (wheel_speeds @ np.array([-1.0, 1.0, -1.0, 1.0])))


def identify_track(difference: FloatArray, yaw_rate: FloatArray) -> float:
    """Track [m] by which right minus left rim speed (K,) [m/s] becomes a yaw rate (K,) [rad/s], by least squares.

    With the measured yaw rate it is the effective track, on a skid-steer wider than the geometric one; with the
    commanded yaw rate and settled wheels, that of the firmware times the motors' gain.

    Raises
    ------
    ValueError
        If the data do not turn, or turn against the wheels.
    """
    turning = float(yaw_rate @ yaw_rate)
    slope = float(difference @ yaw_rate) / turning if turning > 0 else 0.0
    if slope <= 0:
        raise ValueError("no track can be found: the yaw rate is zero or runs against the wheels; check its sign")
    # Errors lie in the gyro, so it is regressed on the wheels: yaw rate = difference / track.
    return float(difference @ difference) / float(difference @ yaw_rate)
