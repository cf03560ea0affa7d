"""Random smooth paths, named by seed: `spline-0`, `spline-1`, and so on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.two_sided import side_of
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timing import Timing
from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints


class RandomSplines(StrictModel):
    """Parameters of the distribution of random paths, and of their timing."""

    timing: Timing = Field(description="timing of the path")
    legs: int = Field(ge=1, description="number of legs between waypoints")
    leg: tuple[float, float] = Field(description="minimum and maximum length of a leg [m]")
    turn: float = Field(gt=0, description="maximum turn between consecutive legs [rad]")
    turn_radius: float = Field(gt=0, description="minimum radius of a path [m]")
    speed: float = Field(gt=0, description="maximum speed [m/s]")
    omega: float = Field(gt=0, description="maximum yaw rate [rad/s]")

    def waypoints(self, seed: int) -> FloatArray:
        """Draw waypoints (legs + 1, 2) x, y [m] for a seed; the path starts at the origin in the direction of x."""
        random = np.random.default_rng(seed)
        while True:
            heading = np.append(0.0, np.cumsum(random.uniform(-self.turn, self.turn, self.legs - 1)))
            steps = random.uniform(*self.leg, self.legs)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
            points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
            try:
                path = smooth_path(points, f"seed {seed}")
            except ConfigError:  # a turn is too tight for `smooth_path`
                continue
            # A path with a tight turn is drawn again; the result still depends only on the seed.
            if path.bend.max() * self.turn_radius <= 1:
                return points


@cache
def random_splines() -> RandomSplines:
    """Load the parameters from `random_spline.yaml` of this package."""
    return load_checked(RandomSplines, Path(__file__).parent / "random_spline.yaml")


def time_random_spline(seed: int, limits: TrajectoryLimits, timing: Timing | None = None) -> SplineTrajectory:
    """Build the trajectory of a seed within `limits` and the limits of the settings; the result is bit-reproducible.

    `timing` replaces the timing of the settings. Raises ConfigError if the timing "commanded" exceeds the yaw limit.
    """
    settings = random_splines()
    reduced = replace(limits, v=min(side_of(limits.v, 1.0), settings.speed), omega=min(limits.omega, settings.omega))
    points = [(float(x), float(y)) for x, y in settings.waypoints(seed)]
    name = f"spline-{seed}"
    return time_waypoints(points, reduced, name=name, where=name, timing=timing or settings.timing, max_deviation=None)
