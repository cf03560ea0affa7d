"""Smoothing of a line within a tube, for instance of a staircase of grid cells.

Whittaker's smoother (Proc. Edinburgh Math. Soc. 41, 1923) minimises the sum of squared third differences and weighted
squared distances from the points. The weights are computed iteratively. The weight of a point increases if its distance
is near or beyond the tube, otherwise it decreases, so that the line uses the width of the tube in bends.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg import solveh_banded

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray

_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])
_PINNED = 1e8
_MIN_WEIGHT, _MAX_WEIGHT = 1e-3, 1e6
_MIN_FACTOR, _MAX_FACTOR = 0.3, 4.0
# Target distance as a share of the tube [-]; minimum and maximum number of iterations.
_AIM, _MIN_ITERATIONS, _MAX_ITERATIONS = 0.85, 8, 80


def smooth_in_tube(points: FloatArray, spacing: float, tube: float, length: float, pinned: FloatArray) -> FloatArray:
    """Smooth a line of evenly spaced points within a tube.

    Parameters
    ----------
    points
        (n, 2) x, y [m], n >= 4.
    spacing
        Distance between consecutive points [m].
    tube
        Maximum distance from the points [m]. If the iterations do not reach this distance, the result is the line with
        the lowest maximum distance.
    length
        Wavelength below which waves are removed, as far as the tube permits [m].
    pinned
        (n,) True for fixed points.

    Returns
    -------
    FloatArray
        (n, 2) smoothed points x, y [m].
    """
    count = len(points)
    # Upper bands of D'D, for `solveh_banded`.
    bending = np.zeros((4, count))
    for first in range(4):
        for second in range(first, 4):
            bending[3 - (second - first), second : second + count - 3] += _DIFFERENCE[first] * _DIFFERENCE[second]
    # Squared third differences of a wave decrease with the sixth power of its wavelength in points.
    bending *= (length / spacing) ** 6
    weights, best, min_distance = np.ones(count), points, np.inf
    for iteration in range(_MAX_ITERATIONS):
        # The weight of pinned points exceeds that of the bending for any wavelength.
        matrix, diagonal = bending.copy(), np.where(pinned, _PINNED * max(1.0, (length / spacing) ** 6), weights)
        matrix[3] += diagonal
        line = solveh_banded(matrix, diagonal[:, None] * points)
        distance = np.hypot(*(line - points).T)
        max_distance = float(distance.max())
        if max_distance < min_distance:
            best, min_distance = line, max_distance
        if max_distance <= tube and iteration >= _MIN_ITERATIONS:
            return np.asarray(line)
        weights *= np.clip(distance / (_AIM * tube), _MIN_FACTOR, _MAX_FACTOR)
        weights = np.clip(weights, _MIN_WEIGHT, _MAX_WEIGHT)
    return np.asarray(best)


# Settings of the interpretation and smoothing of a planner path.


Positive = Annotated[float, Field(gt=0)]


class PlannedSettings(StrictModel):
    """Resolutions and thresholds of the conversion of planner paths."""

    coincident: Positive = Field(description="distance below which poses count as one position [m]")
    spacing: Positive = Field(description="distance between smoothed points [m]")
    smoothing_length: Positive = Field(description="wavelength below which waves of a path are removed [m]")
    bendable: Positive = Field(description="maximum end heading difference reached by bending [rad]")
    sideways: Positive = Field(description="minimum |cos| between heading and travel for a sense [-]")
    least_run: Positive = Field(description="minimum length of a part with one sense; shorter parts are noise [m]")
    hairpin: Positive = Field(description="turn of a path above which the robot reverses on the spot [rad]")
    hairpin_length: Positive = Field(description="distance on both sides over which a turn is measured [m]")
    join: Positive = Field(description="length of the approach from the robot to the path [m]")
    turns_per_metre: Positive = Field(description="maximum number of reversals per metre of a path [1/m]")
    turns_allowed: Annotated[int, Field(ge=0)] = Field(description="number of additional allowed reversals [-]")
    longest: Positive = Field(description="maximum length of a path [m]")


@cache
def load_settings() -> PlannedSettings:
    """Read the settings of the package."""
    return load_checked(PlannedSettings, Path(__file__).parent / "settings.yaml")
