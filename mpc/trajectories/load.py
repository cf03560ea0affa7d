"""Loading of trajectories by name or path; the content of a file selects the reader."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError, check, describe_kind, read_yaml
from diffdrive_mpc.models.errors import checked_call, wrong_type
from diffdrive_mpc.models.named_file import is_file, named_file, shipped_names
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.native import TableTrajectory
from diffdrive_mpc.mpc.trajectories.segments import Segment, SegmentFile, time_commands, time_segments
from diffdrive_mpc.mpc.trajectories.speed_passport import PassportUse, SpeedCaps, load_speed_caps
from diffdrive_mpc.mpc.trajectories.timing import TIMINGS, Timing
from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory

_FOLDER = Path(__file__).parent / "built_in"

BUILT_IN: tuple[str, ...] = shipped_names(_FOLDER)
"""Names of the built-in trajectories."""
_RANDOM = "spline-SEED"
"""Pattern of the names of random splines, for messages."""
_SLOWER = "give a file with a slower path, such as first_circle.yaml of identify, or --scale-to-robot (simulate, bench)"
"""Remedy for a built-in path that is too fast for the robot."""


@checked_call()
def load_trajectory(
    name_or_path: str | Path, limits: TrajectoryLimits | ControllerConfig | None = None, timing: str | None = None
) -> Trajectory:
    """Load a reference trajectory.

    Parameters
    ----------
    name_or_path
        One of: a name in `BUILT_IN`; `spline-` and a seed for a random smooth path; a YAML file with `segments` (a list
        of v [m/s], omega [rad/s], duration [s]) or `waypoints` (a list of x, y [m]); a CSV file of timed poses with the
        columns t [s], x, y [m], theta [rad].
    limits
        Speed and acceleration limits, or a configuration that contains them; by default the limits of the robot of the
        papers. A configuration also sets the standstill before the start, `start_delay`.
    timing
        "stop", "commanded" or "smooth", see `timing.Timing`; replaces the timing in the file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the name is unknown, the file is missing, malformed, empty or exceeds the limits, or the timing is unknown or
        given for timed poses.
    ArgumentError
        If the argument is neither a name nor a path.
    """
    if not isinstance(name_or_path, (str, Path)):
        raise wrong_type(
            "load_trajectory",
            "a name such as 'circle' or the path of a file",
            name_or_path,
            "create one from arrays with Trajectory.from_arrays(t, x, y) or Trajectory.from_waypoints(points)",
        )
    if not isinstance(limits, TrajectoryLimits | ControllerConfig | None):
        raise wrong_type("limits", "the limits of a robot", limits, "the timing is a keyword: timing='smooth'")
    selected_timing = next((known for known in TIMINGS if known == timing), None)
    if timing is not None and selected_timing is None:
        raise ConfigError(f"timing '{timing}': give {', '.join(TIMINGS)}; default: that of the file (--timing file)")
    if isinstance(limits, ControllerConfig):
        loaded = load_trajectory(name_or_path, TrajectoryLimits.of_controller(limits.limits), timing)
        assert isinstance(loaded, TableTrajectory)
        return loaded.delayed(limits.start_delay) if limits.start_delay else loaded
    if random := _match_random(name_or_path):
        from diffdrive_mpc.mpc.trajectories.random_spline import time_random_spline  # noqa: PLC0415 - see _read

        return time_random_spline(int(random[1]), limits or TrajectoryLimits.of_robot(), selected_timing)
    path = trajectory_file(name_or_path)
    try:
        trajectory = _read(path, limits or TrajectoryLimits.of_robot(), selected_timing)
    except BeyondLimitError as error:
        if path.parent == _FOLDER:  # the user cannot lower the speed in a built-in file
            raise BeyondLimitError(f"{str(error).removesuffix('; lower it')}; {_SLOWER}") from error
        if limits is not None:
            raise
        remedy = "This is the limit of the papers' robot; for another robot: load_trajectory(path, config)"
        raise BeyondLimitError(f"{error}. {remedy}") from error
    max_duration = load_settings().max_duration
    if trajectory.duration > max_duration:
        raise ConfigError(
            f"{path}: the duration is {trajectory.duration:.3g} s, at most {max_duration:g} s: are times in s?"
        )
    return trajectory


def _match_random(name_or_path: str | Path) -> re.Match[str] | None:
    return re.fullmatch(r"spline-(\d{1,1000})", str(name_or_path), re.ASCII)


def trajectory_file(name_or_path: str | Path) -> Path:
    """Return the path of a trajectory file; raise ConfigError if it does not exist. Random splines have no file."""
    # The most similar built-in name is fast_circle, which is no path for a first drive.
    if Path(str(name_or_path)).stem == "first_circle" and not is_file(name_or_path):
        remedy = "give the path of first_circle.yaml in the folder that identify wrote"
        raise ConfigError(f"trajectory '{name_or_path}': there is no such file; {remedy}")
    return named_file("trajectory", _FOLDER, name_or_path, BUILT_IN, f", {_RANDOM}")


def load_segments(name_or_path: str | Path) -> tuple[Segment, ...]:
    """Load the segments of a trajectory file without timing them; raise ConfigError as `load_segment_file`."""
    return tuple(load_segment_file(name_or_path).segments)


def load_segment_file(name_or_path: str | Path) -> SegmentFile:
    """Load a trajectory file of segments without timing them.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the name is unknown, or the file is missing, is malformed, or does not consist of segments.
    """
    path = None if _match_random(name_or_path) else trajectory_file(name_or_path)
    data = None if path is None or path.suffix.lower() == ".csv" else read_yaml(path)
    if data is None or (isinstance(data, Mapping) and "waypoints" in data):
        raise ConfigError(
            f"{name_or_path}: --scale-to-robot and load_segments need a path of segments, such as circle; other paths "
            "are driven as they are, within the limits of the configuration"
        )
    return check(SegmentFile, data, str(path))


def _read(path: Path, limits: TrajectoryLimits, timing: Timing | None) -> Trajectory:
    # SciPy is imported slowly, and most built-in trajectories consist of arcs, which do not need SciPy.
    if path.suffix.lower() == ".csv":
        from diffdrive_mpc.mpc.trajectories.timed_poses import read_timed_poses  # noqa: PLC0415

        if timing is not None:
            raise ConfigError(f"{path}: timing '{timing}': timed poses already have times; remove the timing")
        return read_timed_poses(path, limits)
    data, where = read_yaml(path), str(path)
    if isinstance(data, Mapping) and "waypoints" in data:
        from diffdrive_mpc.mpc.trajectories.waypoints import WaypointFile, time_waypoints  # noqa: PLC0415

        route = check(WaypointFile, data, where)
        name, selected_timing = route.name or path.stem, timing or route.timing
        caps = _load_caps(route.speed_passport, selected_timing, path)
        trajectory = time_waypoints(
            route.waypoints,
            limits,
            name=name,
            speed=route.speed,
            where=where,
            timing=selected_timing,
            caps=caps,
            max_deviation=route.max_deviation,
        )
        return _with_remark(trajectory, "the polyline of its waypoints")
    if isinstance(data, Mapping) and "segments" not in data and describe_kind(data) is None:
        raise ConfigError(f"{where}: has neither 'segments' nor 'waypoints'; write waypoints: [[X, Y], [X, Y]]")
    sequence = check(SegmentFile, data, where)
    segments, start, selected_timing = sequence.segments, sequence.start, timing or sequence.timing
    name, caps = sequence.name or path.stem, _load_caps(sequence.speed_passport, selected_timing, path)
    if selected_timing == "smooth":
        from diffdrive_mpc.mpc.trajectories.smooth_segments import time_smooth_path  # noqa: PLC0415

        smooth = time_smooth_path(
            segments, limits, name=name, start=start, where=where, smoothing=sequence.smoothing, caps=caps
        )
        return _with_remark(smooth, "the drawn path", selected_timing, segments)
    lay = time_commands if selected_timing == "commanded" else time_segments
    return _with_remark(lay(segments, limits, name=name, start=start, where=where), "", selected_timing, segments)


_TIME_TOLERANCE = 0.01
"""Relative difference of durations without a remark [-]; every drive with `timing: stop` has a ramp at both ends."""


def _with_remark(trajectory: Trajectory, path: str, timing: str = "", segments: Sequence[Segment] = ()) -> Trajectory:
    """Add a remark on the duration compared with `segments`, and on the distance from the path of the file.

    `path` is the name of the path of the file in the remark; empty if both paths are equal.
    """
    file_time, drive_time, parts = sum(part.duration for part in segments), trajectory.duration, []
    if segments and abs(drive_time - file_time) > _TIME_TOLERANCE * file_time:
        parts.append(f"{file_time:.1f} s in the file, driven in {drive_time:.1f} s (timing: {timing})")
    if path:
        max_distance = float(trajectory.drawn_distance(getattr(trajectory, "breaks", ())).max())
        if f"{max_distance:.3f}" != "0.000":
            parts.append(f"its path is up to {max_distance:.3f} m from {path}; errors refer to its path")
    return replace(trajectory, remark=f"trajectory '{trajectory.name}': {'; '.join(parts)}") if parts else trajectory


def _load_caps(use: PassportUse | None, timing: Timing, path: Path) -> SpeedCaps | None:
    """Load the speed limits of the passport of the trajectory file at `path`; None if the file uses no passport."""
    if use is not None and timing != "smooth":
        raise ConfigError(f"{path}: speed_passport: not available with timing '{timing}'; use 'smooth'")
    return None if use is None else load_speed_caps(use, path.parent)
