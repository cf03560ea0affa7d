"""Conversion of a planner path to a timed reference that starts at the robot, with turns on the spot if needed."""

from __future__ import annotations

import math
from bisect import bisect
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.two_sided import side_of
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds, time_path
from diffdrive_mpc.mpc.trajectories.planned.tube import load_settings, smooth_in_tube
from diffdrive_mpc.mpc.trajectories.segments import Segment
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath, smooth_path
from diffdrive_mpc.mpc.trajectories.smooth_segments import Nodes, turn_nodes
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# Interpretation of the poses of a planner: parts that are driven forwards or backwards, and turns on the spot.


@dataclass(frozen=True, eq=False)
class DirectedPart:
    """Part of a path that is driven in one direction between two stops.

    Attributes
    ----------
    points
        (k, 2) x, y [m], k >= 2; consecutive points differ.
    sense
        Direction of travel: 1 forwards, -1 backwards.
    first, last
        Headings of the poses at the ends [rad]; None if unknown.
    """

    points: FloatArray
    sense: int
    first: float | None
    last: float | None

    @property
    def length(self) -> float:
        """Length of the part [m]."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


def read_runs(poses: FloatArray, robot: FloatArray, *, backwards: bool = True) -> list[DirectedPart]:
    """Divide a path into parts at the points where the direction of travel changes.

    A part whose poses point against the direction of travel is driven backwards. Poses at the same position with
    different headings are a turn on the spot. Some planners set only the last heading and leave the others at 0.
    Headings of exactly 0 are ignored if they contradict the direction of travel or the heading of the robot; such a
    path is driven forwards.

    Parameters
    ----------
    poses
        (n, 3) finite x, y [m], theta [rad].
    robot
        (3,) pose of the robot.
    backwards
        True if parts may be driven backwards.

    Returns
    -------
    list of DirectedPart
        Parts in order of travel; empty if all poses are at one position.
    """
    settings = load_settings()
    is_apart = np.hypot(*np.diff(poses[:, :2], axis=0).T) > settings.coincident
    firsts = np.concatenate([[0], np.flatnonzero(is_apart) + 1])
    lasts = np.concatenate([firsts[1:] - 1, [len(poses) - 1]])
    if firsts.size < 2:
        return []
    points = poses[firsts, :2]
    # The path ends exactly at the position of the last pose.
    points[-1] = poses[-1, :2]
    # Of several poses at one position, the first has the heading of arrival, the last that of departure.
    arrival_heading, departure_heading = poses[firsts, 2], poses[lasts, 2]
    step = np.diff(points, axis=0)
    lengths, travel = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    # 1 if the poses point along the direction of travel, -1 if against it.
    alignment = np.cos(departure_heading[:-1] - travel)
    has_headings = _has_headings(poses, alignment, robot)
    senses = np.where(np.abs(alignment) < settings.sideways, 0, np.sign(alignment)).astype(int)
    if not (has_headings and backwards):
        senses = np.ones_like(senses)
    senses = _filter_senses(senses, lengths, settings.least_run)
    turns = np.abs(wrap_angle(departure_heading - arrival_heading)) > (settings.bendable if has_headings else np.inf)
    split_indices = [0, *(i for i in range(1, len(lengths)) if senses[i] != senses[i - 1] or turns[i]), len(lengths)]
    runs: list[DirectedPart] = []
    for start, end in pairwise(split_indices):
        first = float(departure_heading[start]) if has_headings else None
        last = float(arrival_heading[end]) if has_headings or end == len(lengths) else None
        runs += _split_at_hairpins(DirectedPart(points[start : end + 1], int(senses[start]), first, last))
    max_reversals = settings.turns_allowed + settings.turns_per_metre * float(lengths.sum())
    if len(runs) - 1 > max_reversals:
        raise ConfigError(
            f"path: it reverses {len(runs) - 1} times in {lengths.sum():.2f} m; smooth it, or plan another path"
        )
    return runs


def _has_headings(poses: FloatArray, alignment: FloatArray, robot: FloatArray) -> bool:
    """Return True if the headings except the last are valid, False if a planner has left them at 0."""
    if np.any(np.abs(poses[:-1, 2]) > 1e-9):
        return True
    sideways = bool(np.any(np.abs(alignment) < load_settings().sideways))
    return not sideways and math.cos(float(robot[2])) > load_settings().sideways


def _filter_senses(senses: FloatArray, lengths: FloatArray, min_length: float) -> FloatArray:
    """Replace senses (m,) of sections shorter than `min_length` [m], and unknown senses, by those of neighbours."""
    known_indices = np.flatnonzero(senses)
    filtered = (
        np.ones_like(senses)
        if not known_indices.size
        else senses[known_indices[np.searchsorted(known_indices[1:], np.arange(senses.size), side="right")]]
    )
    edges = [0, *(np.flatnonzero(np.diff(filtered)) + 1).tolist(), filtered.size]
    for start, end in pairwise(edges):
        if lengths[start:end].sum() < min_length:
            filtered[start:end] = filtered[start - 1] if start else filtered[min(end, filtered.size - 1)]
    return np.asarray(filtered)


def _split_at_hairpins(run: DirectedPart) -> list[DirectedPart]:
    """Split a part at reversals, where the path turns back on itself."""
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    reach = settings.hairpin_length

    def point_at(s: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(s, along, run.points[:, i]) for i in (0, 1)])

    inside = np.flatnonzero((along > settings.least_run) & (along < along[-1] - settings.least_run))
    vertex = run.points[inside]
    before, after = vertex - point_at(along[inside] - reach), point_at(along[inside] + reach) - vertex
    turn = np.abs(np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1)))
    # Near a reversal, incoming and outgoing path cancel, so the chords are longest exactly at the reversal.
    sharpness = np.hypot(*before.T) * np.hypot(*after.T)
    split_indices: list[int] = []
    for i in sorted(np.flatnonzero(turn > settings.hairpin), key=lambda i: -sharpness[i]):
        cut = int(inside[i])
        index = bisect(split_indices, cut)
        # Only the adjacent cuts can be too close.
        neighbours = split_indices[max(0, index - 1) : index + 1]
        if all(abs(along[cut] - along[other_cut]) > reach for other_cut in neighbours):
            split_indices.insert(index, cut)
    edges = [0, *split_indices, len(run.points) - 1]
    last = len(edges) - 2
    return [
        DirectedPart(
            run.points[start : end + 1],
            run.sense,
            run.first if i == 0 else None,
            run.last if i == last else None,
        )
        for i, (start, end) in enumerate(pairwise(edges))
    ]


_PIECES = 3
# Minimum number of points of a smoothed line.
_MIN_POINTS = 8
# Number of points before or after a line that define its direction, and maximum curvature of these points [1/m].
_BEYOND = 3
_MAX_CURVATURE = 3.0
# Minimum turn on the spot, above rounding errors [rad], and speed below which the robot is at standstill [m/s].
_NO_TURN, _STANDING = 1e-3, 0.02
_MIN_INTERVAL = 1e-9  # [s]


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Reference along a planner path.

    Attributes
    ----------
    reference
        Reference to track.
    length
        Length of the path from the robot to the end of the path [m].
    deviation
        Maximum distance of the reference from the polyline of the planner [m], without the approach of the robot.
    begins
        Distance of the robot from the start of the reference [m].
    note
        Note for the result of a goal, such as a reduced speed; empty without a note.
    """

    reference: SplineTrajectory
    length: float
    deviation: float
    begins: float
    note: str = ""


def lay_poses(
    poses: FloatArray,
    limits: TrajectoryLimits,
    *,
    robot: FloatArray,
    twist: tuple[float, float] = (0.0, 0.0),
    deviation: float,
    max_offset: float,
    backwards: bool = True,
    name: str = "path",
) -> PlannedPath:
    """Create a reference along the poses of a planner, which ends at rest at the last pose, including its heading.

    The reference starts near the robot with the robot's twist, so that a new path replaces the previous path without a
    stop. It stops at reversals and at turns on the spot. There is a turn before the path if a robot at standstill has
    another heading, and a turn at the end if the heading of the goal differs from that of the path.

    Parameters
    ----------
    poses
        (n, 3), n >= 2: x, y [m], theta [rad].
    limits
        Speed and acceleration limits; a minimum turn radius excludes turns on the spot.
    robot
        (3,) pose of the robot in the frame of the poses.
    twist
        Forward speed [m/s] and yaw rate [rad/s] of the robot.
    deviation
        Maximum distance of the reference from the polyline of the planner [m].
    max_offset
        Maximum distance of the robot from the path at which the reference starts at the robot [m].
    backwards
        True to drive parts backwards if their poses point against the direction of travel.
    name
        Name of the reference.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are too few poses, a pose is not finite, the path is too long or has too many reversals, or all poses
        are at one position and no turn is needed or allowed.
    """
    settings = load_settings()
    _check(poses, settings.longest)
    poses = remaining_poses(poses, robot)
    runs = read_runs(poses, robot, backwards=backwards)
    nodes: list[Nodes] = []
    speed, yaw_rate = twist
    is_standing = abs(speed) < _STANDING
    # The path continues the curve that the robot drives now.
    bend = 0.0 if is_standing else max(-_MAX_CURVATURE, min(_MAX_CURVATURE, yaw_rate / abs(speed)))
    may_turn = not limits.min_turn_radius
    pose = np.array([*poses[0, :2], robot[2]])
    max_distance = 0.0
    # The robot stops between runs, so only the first run depends on its current motion.
    for index, run in enumerate(runs):
        line, ends, drawn = _smooth_line(run, pose if index == 0 else None, bend, deviation, max_offset)
        max_distance = max(max_distance, float(drawn.max()))
        path = _heading_path(line, ends, run.sense)
        gap = float(wrap_angle(path.heading[0] - pose[2]))
        # Only the component of the robot's speed along the path continues.
        begins = max(0.0, run.sense * speed * math.cos(gap)) if index == 0 else 0.0
        # At the start, a small difference is bent away, and a robot in motion does not stop to turn.
        if may_turn and (index or (is_standing and abs(gap) > settings.bendable)) and abs(gap) > _NO_TURN:
            nodes += _turn(np.array([*path.points[0], pose[2]]), gap, limits)
        square = squared_speeds(
            path.lengths, path.bend, path.bend_change, limits, math.inf, lateral=True, enter=begins, sense=run.sense
        )
        times, node_poses, rates = time_path(path, square, limits, run.sense)
        nodes.append(
            # `drawn` belongs to the points of the line, which has several nodes per point.
            (times, node_poses, rates, np.interp(np.linspace(0, 1, len(times)), np.linspace(0, 1, len(drawn)), drawn))
        )
        pose = node_poses[-1]
    gap = float(wrap_angle(poses[-1, 2] - pose[2]))
    if may_turn and abs(gap) > _NO_TURN:
        nodes += _turn(np.array([*poses[-1, :2], pose[2]]), gap, limits)
    if not nodes:
        raise ConfigError("path: all poses are at one position, and no turn is needed or allowed")
    reference = _join(nodes, float(robot[2]), name)
    start = reference.sample([0.0]).pose[0]
    return PlannedPath(reference, sum(run.length for run in runs), max_distance, float(np.hypot(*(start - robot)[:2])))


def _check(poses: FloatArray, max_length: float) -> None:
    if len(poses) < 2:
        raise ConfigError(f"path: it has {len(poses)} poses; give at least two")
    invalid = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if invalid.size:
        raise ConfigError(f"path: pose {invalid[0]} is not finite")
    length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    if length > max_length:
        raise ConfigError(f"path: its length is {length:.3g} m, at most {max_length:g} m: are positions in m?")


def remaining_poses(poses: FloatArray, robot: FloatArray) -> FloatArray:
    """Return the part of the poses (n, 3) ahead of `robot` (3,), which has moved since the path was planned."""
    step = np.diff(poses[:, :2], axis=0)
    lengths = np.hypot(*step.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    gap = robot[:2] - poses[:-1, :2]
    share = np.clip((gap * step).sum(axis=1) / np.maximum(lengths**2, 1e-12), 0.0, 1.0)
    closest_points = poses[:-1, :2] + share[:, None] * step
    distance = np.hypot(*(closest_points - robot[:2]).T)
    # The path may pass the same position again, so the search is limited to the distance that the robot can cover.
    is_near = along[:-1] <= 2.0 * float(np.hypot(*(robot - poses[0])[:2])) + load_settings().spacing
    # The search also ends at a reversal.
    reversals = np.flatnonzero((step[1:] * step[:-1]).sum(axis=1) < 0)
    if reversals.size:
        is_near[reversals[0] + 1 :] = False
    nearest = int(np.argmin(np.where(is_near, distance, np.inf)))
    if nearest == 0 and share[0] == 0.0:
        return poses
    first = np.array([*closest_points[nearest], poses[nearest, 2]])
    return np.concatenate([first[None], poses[nearest + 1 :]])


_Ends = tuple[float | None, float | None]


def _smooth_line(
    run: DirectedPart, robot: FloatArray | None, bend: float, deviation: float, max_offset: float
) -> tuple[FloatArray, _Ends, FloatArray]:
    """Fit a smooth line (m, 2) to a part; return the line, its end headings, and its distances from the part (m,) [m].

    With `robot` (3,), the line starts at the robot if the distance of the part is at most `max_offset` [m]. It starts
    with the robot's heading if the difference of headings is small enough, and with the curvature `bend` [1/m].
    """
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    count = max(_MIN_POINTS, 1 + math.ceil(along[-1] / settings.spacing))
    # `smooth_in_tube` requires evenly spaced points.
    arc_length = np.linspace(0.0, along[-1], count)
    points = np.column_stack([np.interp(arc_length, along, run.points[:, i]) for i in (0, 1)])
    spacing = float(arc_length[1])
    target, first, is_approach = points.copy(), run.first, np.zeros(count, dtype=bool)
    if robot is not None:
        offset = robot[:2] - points[0]
        if np.hypot(*offset) <= max_offset:
            length = min(settings.join, float(along[-1]))
            # The offset fades out quadratically, so the approach ends without a kink.
            target += offset * np.maximum(0.0, 1.0 - arc_length / length)[:, None] ** 2
            is_approach, first = arc_length < length, float(robot[2])
    interval = min(count - 1, max(2, round(2 * settings.hairpin_length / spacing)))
    ends: list[float | None] = []
    parts = [target]
    for heading, end, side in ((first, 0, 1), (run.last, count - 1, -1)):
        ends.append(None)
        if heading is None:
            continue
        travel = heading if run.sense > 0 else heading + math.pi
        chord = side * (target[end + side * interval] - target[end])
        if abs(float(wrap_angle(travel - math.atan2(chord[1], chord[0])))) > settings.bendable:
            continue
        ends[-1] = travel
        # Additional points beyond the end, on the arc or straight line with the given direction.
        beyond = spacing * np.arange(1, _BEYOND + 1)
        turn = -0.5 * beyond * (bend if side > 0 and robot is not None else 0.0)
        direction = travel + turn
        extension = target[end] - side * beyond[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        parts = [extension[::-1], *parts] if side > 0 else [*parts, extension]
    line = np.concatenate(parts)
    before = _BEYOND if ends[0] is not None else 0
    is_fixed = np.ones(len(line), dtype=bool)
    is_fixed[before + 1 : before + count - 1] = False
    smooth = smooth_in_tube(line, spacing, deviation, settings.smoothing_length, is_fixed)[before : before + count]
    return smooth, (ends[0], ends[1]), np.where(is_approach, 0.0, np.hypot(*(smooth - points).T))


def _heading_path(line: FloatArray, ends: _Ends, sense: int) -> SmoothPath:
    """Return the smooth path along a line, with the heading of the robot instead of the direction of travel."""
    path = smooth_path(line, "path", _PIECES, ends)
    if sense > 0:
        return path
    return SmoothPath(path.points, path.heading + math.pi, path.curvature, path.lengths, path.bend, path.bend_change)


def _turn(pose: FloatArray, angle: float, limits: TrajectoryLimits) -> list[Nodes]:
    max_rate = side_of(limits.omega, angle)
    segment = Segment(v=0.0, omega=math.copysign(max_rate, angle), duration=abs(angle) / max_rate)
    return list(turn_nodes([segment], pose, limits))


def _join(nodes: list[Nodes], heading: float, name: str) -> SplineTrajectory:
    """Join consecutive parts, and add multiples of 2 pi to their headings; the first part starts near `heading`."""
    time = 0.0
    parts: list[Nodes] = []
    for times, poses, rates, drawn in nodes:
        whole = math.tau * round((heading - poses[0, 2]) / math.tau)
        shifted = poses + [0.0, 0.0, whole]
        # Rounding can result in two nodes at the same time, of which only the first is used.
        is_later = np.diff(times, prepend=-1.0 if not parts else 0.0) > _MIN_INTERVAL
        parts.append((time + times[is_later], shifted[is_later], rates[is_later], drawn[is_later]))
        time, heading = time + float(times[-1]), float(shifted[-1, 2])
    return SplineTrajectory.through(name, *(np.concatenate(rows) for rows in zip(*parts, strict=True)))
