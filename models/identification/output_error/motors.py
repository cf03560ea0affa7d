"""Motors behind wheel kinematics: the structure of MBM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification.output_error.linear_system import AnyArray
from diffdrive_mpc.models.identification.output_error.structures import TwoPolesStructure
from diffdrive_mpc.models.identification.settings import load_settings
from diffdrive_mpc.models.interface import FloatArray


@dataclass(frozen=True)
class MotorsStructure:
    """One transfer function with two poles for each motor, driven by (v_ref, omega_ref) through the firmware's track.

    Attributes
    ----------
    sides
        For each motor -1 (left) or 1 (right).
    radius
        Wheel radius by which the firmware turns speeds into wheel rates [m].
    """

    sides: tuple[int, ...]
    radius: float

    @property
    def names(self) -> tuple[str, ...]:
        """Three for each motor, then the firmware's track."""
        return (*(f"{name}_{i}" for i in range(len(self.sides)) for name in TwoPolesStructure().names), "log_track")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(3 motors + 1,) bounds from the settings."""
        low, high = TwoPolesStructure().bounds
        track = np.log(load_settings().track)
        count = len(self.sides)
        return np.append(np.tile(low, count), track[0]), np.append(np.tile(high, count), track[1])

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """A (2 motors, 2 motors), B (2 motors, 2), C (motors, 2 motors)."""
        count = len(self.sides)
        A = np.zeros((2 * count, 2 * count), dtype=parameters.dtype)
        B, C = np.zeros((2 * count, 2), dtype=parameters.dtype), np.zeros((count, 2 * count), dtype=parameters.dtype)
        track = np.exp(parameters[-1])
        for i, side in enumerate(self.sides):
            rows = slice(2 * i, 2 * i + 2)
            A[rows, rows], into, C[i : i + 1, rows] = TwoPolesStructure().matrices(parameters[3 * i : 3 * i + 3])
            B[rows] = into * np.array([1.0, 0.5 * side * track]) / self.radius
        return A, B, C

    def recentred(self, parameters: FloatArray) -> tuple[MotorsStructure, FloatArray]:
        """Logarithms suit everywhere."""
        return self, parameters
