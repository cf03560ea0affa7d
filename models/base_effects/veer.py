"""A robot that does not drive straight when its wheels do."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.interface import FloatArray


class Veer(StrictModel):
    """Yaw rate in proportion to forward speed: omega = omega_wheels + yaw_per_metre v, wheels of unequal radius.

    Source: coefficient a31 of Ordonez et al., 2017 (their omega = w_c + a31 v_c + ...).
    """

    yaw_per_metre: float = Field(description="yaw for each metre driven forward, left positive [rad/m]")

    def body(self, wheels: ArrayLike) -> FloatArray:
        """Twists (..., 2) of the body for twists (..., 2) by the wheels."""
        v, omega = np.moveaxis(np.asarray(wheels, dtype=float), -1, 0)
        return np.stack([v, omega + self.yaw_per_metre * v], axis=-1)

    def wheels(self, body: ArrayLike) -> FloatArray:
        """Twists (..., 2) by the wheels for twists (..., 2) of the body: the exact inverse of `body`."""
        v, omega = np.moveaxis(np.asarray(body, dtype=float), -1, 0)
        return np.stack([v, omega - self.yaw_per_metre * v], axis=-1)
