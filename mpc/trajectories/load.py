"""Find a trajectory by name or path, and read it with the reader that fits its content."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.named_file import named_file, shipped_names
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.random_spline import PATTERN, lay_random_spline, seed_of
from diffdrive_mpc.mpc.trajectories.segments import Segment, SegmentFile, lay_commanded, lay_segments
from diffdrive_mpc.mpc.trajectories.settings import load_settings
from diffdrive_mpc.mpc.trajectories.smooth_segments import lay_smooth
from diffdrive_mpc.mpc.trajectories.timed_poses import read_timed_poses
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS, Timing
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory
from diffdrive_mpc.mpc.trajectories.waypoints import WaypointFile, lay_waypoints

_FOLDER = Path(__file__).parent / "built_in"

BUILT_IN: tuple[str, ...] = shipped_names(_FOLDER)
"""Names of the trajectories that ship with the package as files."""


def load_trajectory(
    name_or_path: str | Path, limits: TrajectoryLimits | None = None, timing: str | None = None
) -> Trajectory:
    """Load a reference trajectory.

    Parameters
    ----------
    name_or_path
        A name in `BUILT_IN`; or `spline-` and a seed, a random smooth path; or a YAML file with `segments` (a list of
        v [m/s], omega [rad/s], duration [s]) or with `waypoints` (a list of x, y [m]); or a CSV file of timed poses
        with the columns t [s], x, y [m], theta [rad].
    limits
        Speeds and accelerations to respect; by default those of the robot of the papers.
    timing
        "stop", "commanded" or "smooth" (see `timing.Timing`) in place of what the file says.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the name is unknown, the file is missing, malformed, empty or beyond the limits, or the timing is unknown or
        asked for with timed poses, which have times of their own.
    """
    way = next((one for one in TIMINGS if one == timing), None)
    if timing is not None and way is None:
        raise ConfigError(f"timing '{timing}': give {', '.join(TIMINGS[:-1])} or {TIMINGS[-1]}")
    limits = limits or TrajectoryLimits.of_robot()
    seed = seed_of(name_or_path)
    if seed is not None:
        return lay_random_spline(seed, limits, way)
    path = named_file("trajectory", _FOLDER, name_or_path, BUILT_IN, f", {PATTERN}")
    trajectory = _read(path, limits, way)
    longest = load_settings().longest_duration
    if trajectory.duration > longest:
        raise ConfigError(
            f"{path}: it lasts {trajectory.duration:.3g} s, the longest is {longest:g} s: are times in s?"
        )
    return trajectory


def load_segments(name_or_path: str | Path) -> tuple[Segment, ...]:
    """The segments of a trajectory as its file states them: twists that jump, as a script would command them.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the name is unknown, or the file is missing, malformed or made of something else than segments.
    """
    path = named_file("trajectory", _FOLDER, name_or_path, BUILT_IN)
    return tuple(check(SegmentFile, read_yaml(path), str(path)).segments)


def _read(path: Path, limits: TrajectoryLimits, timing: Timing | None) -> Trajectory:
    if path.suffix.lower() == ".csv":
        if timing is not None:
            raise ConfigError(f"{path}: timing '{timing}': timed poses have times of their own; ask for none")
        return read_timed_poses(path, limits)
    data, where = read_yaml(path), str(path)
    if isinstance(data, Mapping) and "waypoints" in data:
        route = check(WaypointFile, data, where)
        name, way = route.name or path.stem, timing or route.timing
        return lay_waypoints(route.waypoints, limits, name=name, speed=route.speed, where=where, timing=way)
    sequence = check(SegmentFile, data, where)
    segments, start, way = sequence.segments, sequence.start, timing or sequence.timing
    name = sequence.name or path.stem
    if way == "smooth":
        return lay_smooth(segments, limits, name=name, start=start, where=where, smoothing=sequence.smoothing)
    lay = lay_commanded if way == "commanded" else lay_segments
    return lay(segments, limits, name=name, start=start, where=where)
