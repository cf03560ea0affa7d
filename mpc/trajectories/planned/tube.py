"""The least bent line inside a tube: what is left of a staircase when it may be left by so much.

Whittaker's smoother (Proc. Edinburgh Math. Soc. 41, 1923): the sum of squared third differences against the weighted
squared distances from the points. The weights are not given: each grows where its point is left by more than the tube
allows and falls where there is room, until the line uses the tube where it has to bend and nothing of it elsewhere.
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
_LEAST, _MOST = 1e-3, 1e6
_SLOWEST, _FASTEST = 0.3, 4.0
# Share of the tube that is aimed at, at first and at last; iterations.
_AIM, _SETTLED, _ITERATIONS = 0.85, 8, 80


def least_bent(points: FloatArray, spacing: float, tube: float, length: float, pinned: FloatArray) -> FloatArray:
    """Smooth `points` (n, 2), n >= 4, `spacing` [m] apart.

    Parameters
    ----------
    points
        [m].
    spacing
        Distance between neighbours along the line [m].
    tube
        Largest distance from the points [m]. Where that cannot be had in the iterations there are, the line is nearest
        to it that was found.
    length
        Shorter waves are smoothed away where the tube allows it [m].
    pinned
        (n,) of bool: these points stay.

    Returns
    -------
    FloatArray
        (n, 2) [m].
    """
    count = len(points)
    bent = np.zeros((4, count))
    for first in range(4):
        for second in range(first, 4):
            bent[3 - (second - first), second : second + count - 3] += _DIFFERENCE[first] * _DIFFERENCE[second]
    bent *= (length / spacing) ** 6
    weights, best, least = np.ones(count), points, np.inf
    for iteration in range(_ITERATIONS):
        matrix, held = bent.copy(), np.where(pinned, _PINNED * max(1.0, (length / spacing) ** 6), weights)
        matrix[3] += held
        line = solveh_banded(matrix, held[:, None] * points)
        off = np.hypot(*(line - points).T)
        furthest = float(off.max())
        if furthest < least:
            best, least = line, furthest
        if furthest <= tube and iteration >= _SETTLED:
            return np.asarray(line)
        weights = np.clip(weights * np.clip(off / (_AIM * tube), _SLOWEST, _FASTEST), _LEAST, _MOST)
    return np.asarray(best)


# How a planner's path is read and smoothed.


Positive = Annotated[float, Field(gt=0)]


class PlannedSettings(StrictModel):
    """Resolutions and thresholds; distances in m, angles in rad."""

    coincident: Positive = Field(description="closer poses are at one place [m]")
    spacing: Positive = Field(description="of the points that are smoothed [m]")
    smoothing_length: Positive = Field(description="shorter waves of a path are smoothed away [m]")
    bendable: Positive = Field(description="a heading no further off at an end is reached by bending the path [rad]")
    sideways: Positive = Field(description="|cos| between heading and travel from which a pose says the direction [-]")
    least_run: Positive = Field(description="a change of direction that is shorter is noise [m]")
    hairpin: Positive = Field(description="a path that turns so far is turned back on the spot [rad]")
    hairpin_length: Positive = Field(description="over which that is looked at, to either side [m]")
    join: Positive = Field(description="over which a path leads from a robot beside it onto it [m]")
    turns_per_metre: Positive = Field(description="a path that turns back more often is no planner's [1/m]")
    turns_allowed: Annotated[int, Field(ge=0)] = Field(description="so many turns more are allowed [-]")
    longest: Positive = Field(description="a longer path is a mistake of units [m]")


@cache
def load_settings() -> PlannedSettings:
    """Read the settings that ship with the package."""
    return load_checked(PlannedSettings, Path(__file__).parent / "settings.yaml")
