"""Base class of reference trajectories."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import ArgumentError, checked_methods
from diffdrive_mpc.models.interface import FloatArray, ReferenceSample

if TYPE_CHECKING:
    from pathlib import Path

    from diffdrive_mpc.mpc.config.schema import ControllerConfig
    from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
    from diffdrive_mpc.mpc.trajectories.timing import Timing


@checked_methods
@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(ABC):
    """Timed reference, see `models.interface.Reference`.

    Create a trajectory by `load_trajectory`, `from_arrays` or `from_waypoints`.

    Attributes
    ----------
    name
        Name in tables and figures.
    duration
        Time from start to end [s].
    remark
        Differences between the trajectory and its file in duration and path, in one line; empty if there are none.
    """

    name: str
    duration: float
    remark: str = field(default="", kw_only=True)

    def __new__(cls, *_: object, **__: object) -> Trajectory:
        """Create an object of a subclass; raise ArgumentError for this class itself."""
        if cls is Trajectory:
            raise ArgumentError("Trajectory: write Trajectory.from_arrays(t, x, y) or load_trajectory('circle')")
        return super().__new__(cls)

    def __init_subclass__(cls) -> None:
        """Check the calls of all kinds of trajectories."""
        checked_methods(cls)

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
        """Create a trajectory through timed poses by cubic splines in time.

        Speeds are accepted up to 50 m/s; `Controller.start` compares them with the limits of its configuration.

        Parameters
        ----------
        t
            (n,) increasing times [s]; the first time becomes time 0.
        x, y
            (n,) positions [m].
        theta
            (n,) headings [rad], which may be wrapped; by default the direction of travel, reversed if `v` < 0.
        v, omega
            (n,) twist of the body at these times [m/s, rad/s]; by default the twist of a spline through the poses.
        name
            Name in tables and figures.

        Raises
        ------
        ConfigError
            If shapes differ, a value is not finite, times do not increase, or the columns contradict each other.
        ArgumentError
            If `name` is not a text, or empty.
        """
        # SciPy is imported only here, since its import is slow.
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
        """Create a trajectory from rest to rest on a smooth path through waypoints.

        Parameters
        ----------
        points
            (m, 2) x, y [m] in order of travel.
        speed
            Cruise speed [m/s]; by default the limit.
        limits
            Speed and acceleration limits, or a configuration that contains them, or the name or path of a
            configuration. By default the limits of the robot of the papers (1.5 m/s), with a speed limit of at least
            `speed`.
        timing
            "stop", "commanded" or "smooth", see `timing.Timing`.
        max_deviation
            Maximum distance of the path from the polyline of the points [m]; determines the rounding of corners.
        name
            Name in tables and figures.

        Raises
        ------
        ConfigError
            If there are fewer than two points, two consecutive points coincide, or the path turns too tightly.
        ArgumentError
            If `speed` or `limits` has a wrong type.
        """
        from diffdrive_mpc.mpc.trajectories.timed_poses import trajectory_from_waypoints  # noqa: PLC0415

        return trajectory_from_waypoints(
            points, limits, name=name, speed=speed, timing=timing, max_deviation=max_deviation
        )

    def __repr__(self) -> str:
        """Format name, duration and length in one line."""
        length = float(self.sample([self.duration]).arc_length[0])
        return f"Trajectory {self.name!r}: {self.duration:.4g} s, {length:.4g} m"

    @abstractmethod
    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Sample at `times` (n,) [s] since the start of the trajectory.

        The trajectory is at rest at its start pose before time 0, and at its end pose after `duration`. The pose at a
        NaN time is NaN.

        Returns
        -------
        ReferenceSample
            Pose (n, 3) [m, m, rad unwrapped], twist (n, 2) [m/s, rad/s], arc length (n,) [m].
        """

    def drawn_distance(self, times: ArrayLike) -> FloatArray:
        """Compute the distances (n,) [m] from the drawn path at `times` (n,) [s].

        The drawn path is the path in the file before smoothing; for waypoints, the polyline.
        """
        return np.zeros(np.size(times))
