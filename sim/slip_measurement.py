"""Measures how a plant slips, for reports and for the surfaces of velocity-model plants."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.log import Log
from diffdrive_mpc.sim.plants.surface import Slip


def measure_slip(log: Log, on_default: Log) -> Slip:
    """Slip of a drive, each coefficient by least squares through the origin.

    Parameters
    ----------
    log
        Drive on the surface in question, with exact wheel speeds.
    on_default
        The same commands on the default surface, on which velocity models are identified.
    """
    v, lateral, yaw_rate = log.true_twist.T
    return Slip(
        yaw_gain=_slope(on_default.true_twist[:, 2], yaw_rate),
        wheel_yaw_gain=_slope(log.wheel_twist[:, 1], yaw_rate),
        longitudinal_gain=_slope(log.wheel_twist[:, 0], v),
        side_slip=max(0.0, -_slope(v * yaw_rate, lateral)),
    )


def _slope(x: FloatArray, y: FloatArray) -> float:
    return float(np.dot(x, y) / np.dot(x, x))
