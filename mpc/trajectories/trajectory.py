"""Base class of reference trajectories, with name, duration and sampling."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample

if TYPE_CHECKING:
    from pathlib import Path

    from diffdrive_mpc.mpc.config.schema import ControllerConfig
    from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
    from diffdrive_mpc.mpc.trajectories.timing import Timing


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(ABC):
    """A timed reference; satisfies `models.interface.Reference`. Made by `load_trajectory` and the two methods below.

    Attributes
    ----------
    name
        Name for tables and figures.
    duration
        Time from start to end [s].
    remark
        One line on what differs from the file: its duration and its path; empty where nothing does.
    """

    name: str
    duration: float
    remark: str = field(default="", kw_only=True)

    @staticmethod
    def from_arrays(
        t: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        theta: ArrayLike | None = None,
        v: ArrayLike | None = None,
        omega: ArrayLike | None = None,
        *,
        name: str = "arrays",
    ) -> Trajectory:
        """Lay a trajectory through timed poses by cubic splines in time.

        Speeds are not limited here: `Controller.start` compares them with the limits of its configuration.

        Parameters
        ----------
        t
            (n,) increasing times [s]; the first becomes time 0.
        x, y
            (n,) positions [m].
        theta
            (n,) headings [rad], which may be wrapped; by default the direction of travel, backwards where `v` < 0.
        v, omega
            (n,) twist of the body at these times [m/s, rad/s]; by default that of a spline through the poses.
        name
            Name for tables and figures.

        Raises
        ------
        ConfigError
            If shapes differ, a value is not finite, times do not increase, or the columns contradict each other.
        """
        # SciPy loads slowly, and this module is loaded by every trajectory.
        from diffdrive_mpc.mpc.trajectories.timed_poses import trajectory_from_arrays  # noqa: PLC0415

        columns = {"t": t, "x": x, "y": y, "theta": theta, "v": v, "omega": omega}
        return trajectory_from_arrays(name, columns)

    @staticmethod
    def from_waypoints(
        points: ArrayLike,
        *,
        speed: float | None = None,
        limits: TrajectoryLimits | ControllerConfig | str | Path | None = None,
        timing: Timing = "stop",
        max_deviation: float = 0.05,
        name: str = "waypoints",
    ) -> Trajectory:
        """Lay a smooth path through waypoints, driven from rest to rest.

        Parameters
        ----------
        points
            (m, 2) x, y [m] in the order of passing.
        speed
            Cruise speed [m/s]; by default the limit.
        limits
            Speeds and accelerations to respect, or the configuration whose limits they are, or its name or path. By
            default those of the robot of the papers (1.5 m/s), or `speed` where that is more.
        timing
            "stop", "commanded" or "smooth", see `timing.Timing`.
        max_deviation
            Largest distance of the path from the polyline of the points [m]; corners are rounded to keep to it.
        name
            Name for tables and figures.

        Raises
        ------
        ConfigError
            If there are fewer than two points, two that follow each other coincide, or the path turns too tightly.
        ArgumentError
            If `speed` or `limits` has another type.
        """
        from diffdrive_mpc.mpc.trajectories.timed_poses import trajectory_from_waypoints  # noqa: PLC0415

        return trajectory_from_waypoints(
            points, limits, name=name, speed=speed, timing=timing, max_deviation=max_deviation
        )

    def __repr__(self) -> str:
        """Name, duration and length in one line."""
        length = float(self.sample([self.duration]).arc_length[0])
        return f"Trajectory {self.name!r}: {self.duration:.4g} s, {length:.4g} m"

    @abstractmethod
    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s], counted from the start of the trajectory.

        Before 0 the trajectory rests at its start pose, after `duration` at its end pose, with zero twist. A time
        that is NaN gives a NaN pose.

        Returns
        -------
        ReferenceSample
            pose (n, 3) [m, m, rad unwrapped], twist (n, 2) [m/s, rad/s], arc length (n,) [m].
        """

    def drawn_distance(self, times: ArrayLike) -> FloatArray:
        """Compute the distance (n,) [m] at `times` (n,) [s] from the drawn path, which waypoints draw as a polyline."""
        return np.zeros(np.size(times))
