"""Smoothing of a line within a tube, for instance of a staircase of grid cells.

Whittaker's smoother (Proc. Edinburgh Math. Soc. 41, 1923) minimises the sum of squared third differences and weighted
squared distances from the points. The weights are computed iteratively: the weight of a point increases if the distance
of the line from this point is near or above the radius of the tube, and decreases otherwise. The line therefore uses
the width of the tube in bends.
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

# Coefficients of the third difference.
_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])
# Weight of fixed points, and bounds of the other weights and of their change per iteration [-].
_FIXED = 1e8
_MIN_WEIGHT, _MAX_WEIGHT = 1e-3, 1e6
_MIN_FACTOR, _MAX_FACTOR = 0.3, 4.0
# Target distance as a share of the radius of the tube [-]; minimum and maximum number of iterations.
_TARGET, _MIN_ITERATIONS, _MAX_ITERATIONS = 0.85, 8, 80


def smooth_in_tube(points: FloatArray, spacing: float, tube: float, length: float, is_fixed: FloatArray) -> FloatArray:
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
        Wavelength below which waves are removed, unless they must exceed the tube [m].
    is_fixed
        (n,) True for points that do not move.

    Returns
    -------
    FloatArray
        (n, 2) smoothed points x, y [m].
    """
    count = len(points)
    # Upper bands of D'D for `solveh_banded`, where D computes the third differences.
    bending = np.zeros((4, count))
    for first in range(4):
        for second in range(first, 4):
            bending[3 - (second - first), second : second + count - 3] += _DIFFERENCE[first] * _DIFFERENCE[second]
    # Squared third differences of a wave decrease with the sixth power of its wavelength in points.
    bending *= (length / spacing) ** 6
    weights, best, min_distance = np.ones(count), points, np.inf
    for iteration in range(_MAX_ITERATIONS):
        # The weight of fixed points exceeds that of the bending for any wavelength.
        matrix, diagonal = bending.copy(), np.where(is_fixed, _FIXED * max(1.0, (length / spacing) ** 6), weights)
        matrix[3] += diagonal
        line = solveh_banded(matrix, diagonal[:, None] * points)
        distance = np.hypot(*(line - points).T)
        max_distance = float(distance.max())
        if max_distance < min_distance:
            best, min_distance = line, max_distance
        if max_distance <= tube and iteration >= _MIN_ITERATIONS:
            return np.asarray(line)
        weights *= np.clip(distance / (_TARGET * tube), _MIN_FACTOR, _MAX_FACTOR)
        weights = np.clip(weights, _MIN_WEIGHT, _MAX_WEIGHT)
    return np.asarray(best)


Positive = Annotated[float, Field(gt=0)]


class PlannedSettings(StrictModel):
    """Resolutions and thresholds of the interpretation and smoothing of planner paths."""

    coincident: Positive = Field(description="distance below which poses count as one position [m]")
    spacing: Positive = Field(description="distance between smoothed points [m]")
    smoothing_length: Positive = Field(description="wavelength below which waves of a path are removed [m]")
    bendable: Positive = Field(description="maximum heading difference at an end that bending the path removes [rad]")
    sideways: Positive = Field(description="minimum |cos| between heading and travel for a known sense [-]")
    min_part_length: Positive = Field(description="minimum length of a part with one sense [m]")
    hairpin: Positive = Field(description="turn of a path above which the robot stops and turns on the spot [rad]")
    hairpin_length: Positive = Field(description="length of path on both sides over which a turn is measured [m]")
    join: Positive = Field(description="length of the approach from the robot to the path [m]")
    reversals_per_metre: Positive = Field(description="maximum number of reversals per metre of a path [1/m]")
    base_reversals: Annotated[int, Field(ge=0)] = Field(description="number of reversals allowed on any path [-]")
    max_length: Positive = Field(description="maximum length of a path [m]")


@cache
def load_settings() -> PlannedSettings:
    """Load the settings from `settings.yaml` of this package."""
    return load_checked(PlannedSettings, Path(__file__).parent / "settings.yaml")
