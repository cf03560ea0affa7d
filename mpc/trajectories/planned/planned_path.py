"""Conversion of a planner path to a timed reference that starts near the robot, with turns on the spot if needed."""

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


@dataclass(frozen=True, eq=False)
class DirectedPart:
    """Part of a path that is driven in one direction between two stops.

    Attributes
    ----------
    points
        (k, 2) x, y [m], k >= 2; consecutive points differ.
    sense
        Direction of travel: 1 forwards, -1 backwards.
    start_heading, end_heading
        Headings of the robot at the ends [rad]; None if unknown.
    """

    points: FloatArray
    sense: int
    start_heading: float | None
    end_heading: float | None

    @property
    def length(self) -> float:
        """Length of the part [m]."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


def split_into_parts(poses: FloatArray, robot: FloatArray, *, backwards: bool = True) -> list[DirectedPart]:
    """Split a path into parts at reversals and at turns on the spot.

    A part whose headings point against the direction of travel is driven backwards. Poses at the same position with
    different headings are a turn on the spot. Some planners set only the last heading and leave all others at 0. If all
    headings except the last are 0 and contradict the direction of travel or the heading of the robot, they are ignored
    and the path is driven forwards.

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

    Raises
    ------
    models.checked_yaml.ConfigError
        If the path has too many reversals.
    """
    settings = load_settings()
    has_moved = np.hypot(*np.diff(poses[:, :2], axis=0).T) > settings.coincident
    # Indices of the first and of the last pose at each position.
    arrivals = np.concatenate([[0], np.flatnonzero(has_moved) + 1])
    departures = np.concatenate([arrivals[1:] - 1, [len(poses) - 1]])
    if arrivals.size < 2:
        return []
    points = poses[arrivals, :2]
    # The path ends exactly at the position of the last pose.
    points[-1] = poses[-1, :2]
    # The headings of the first and of the last pose at a position are those of arrival and departure.
    arrival_heading, departure_heading = poses[arrivals, 2], poses[departures, 2]
    step = np.diff(points, axis=0)
    lengths, travel = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    # Cosine of the angle between heading and direction of travel: 1 forwards, -1 backwards.
    alignment = np.cos(departure_heading[:-1] - travel)
    has_headings = _has_headings(poses, alignment, robot)
    senses = np.where(np.abs(alignment) < settings.sideways, 0, np.sign(alignment)).astype(int)
    if not (has_headings and backwards):
        senses = np.ones_like(senses)
    senses = _filter_senses(senses, lengths, settings.min_part_length)
    turns = np.abs(wrap_angle(departure_heading - arrival_heading)) > (settings.bendable if has_headings else np.inf)
    split_indices = [0, *(i for i in range(1, len(lengths)) if senses[i] != senses[i - 1] or turns[i]), len(lengths)]
    parts: list[DirectedPart] = []
    for start, end in pairwise(split_indices):
        start_heading = float(departure_heading[start]) if has_headings else None
        # The last heading is always valid, see `_has_headings`.
        end_heading = float(arrival_heading[end]) if has_headings or end == len(lengths) else None
        part = DirectedPart(points[start : end + 1], int(senses[start]), start_heading, end_heading)
        parts += _split_at_reversals(part)
    max_reversals = settings.base_reversals + settings.reversals_per_metre * float(lengths.sum())
    if len(parts) - 1 > max_reversals:
        raise ConfigError(
            f"path: it reverses {len(parts) - 1} times in {lengths.sum():.2f} m; smooth it, or plan another path"
        )
    return parts


def _has_headings(poses: FloatArray, alignment: FloatArray, robot: FloatArray) -> bool:
    """Return True if all headings are valid, False if the planner has set only the last heading."""
    if np.any(np.abs(poses[:-1, 2]) > 1e-9):
        return True
    # Headings of 0 are plausible if the path and the robot point approximately along the x axis.
    is_sideways = bool(np.any(np.abs(alignment) < load_settings().sideways))
    return not is_sideways and math.cos(float(robot[2])) > load_settings().sideways


def _filter_senses(senses: FloatArray, lengths: FloatArray, min_length: float) -> FloatArray:
    """Replace unknown senses (0), and senses of sections shorter than `min_length` [m], by those of the neighbours.

    The sense (m,) of each piece between two points is 1 forwards, -1 backwards, and 0 if it is unknown. `lengths` (m,)
    are the lengths of the pieces [m].
    """
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


def _split_at_reversals(part: DirectedPart) -> list[DirectedPart]:
    """Split a part at its hairpins, where the robot stops and turns on the spot."""
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(part.points, axis=0).T))])
    reach = settings.hairpin_length

    def point_at(s: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(s, along, part.points[:, i]) for i in (0, 1)])

    inside = np.flatnonzero((along > settings.min_part_length) & (along < along[-1] - settings.min_part_length))
    vertex = part.points[inside]
    incoming, outgoing = vertex - point_at(along[inside] - reach), point_at(along[inside] + reach) - vertex
    cross = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
    turn = np.abs(np.arctan2(cross, (incoming * outgoing).sum(axis=1)))
    # A chord that spans the reversal is shortened by the fold, so both chords are longest exactly at the reversal.
    sharpness = np.hypot(*incoming.T) * np.hypot(*outgoing.T)
    split_indices: list[int] = []
    for i in sorted(np.flatnonzero(turn > settings.hairpin), key=lambda i: -sharpness[i]):
        cut = int(inside[i])
        index = bisect(split_indices, cut)
        # The split indices are sorted, so only the two adjacent ones can be too close.
        neighbours = split_indices[max(0, index - 1) : index + 1]
        if all(abs(along[cut] - along[neighbour]) > reach for neighbour in neighbours):
            split_indices.insert(index, cut)
    edges = [0, *split_indices, len(part.points) - 1]
    last = len(edges) - 2
    return [
        DirectedPart(
            part.points[start : end + 1],
            part.sense,
            part.start_heading if i == 0 else None,
            part.end_heading if i == last else None,
        )
        for i, (start, end) in enumerate(pairwise(edges))
    ]


# Number of pieces of the speed profile between two points of a smoothed line.
_PIECES = 3
# Minimum number of points of a smoothed line.
_MIN_POINTS = 8
# Number of points that extend a line beyond an end to fix its direction, and maximum curvature of the extension [1/m].
_EXTENSION_POINTS = 3
_MAX_CURVATURE = 3.0
# Minimum turn on the spot, above rounding errors [rad], and speed below which the robot is at standstill [m/s].
_MIN_TURN, _STANDSTILL_SPEED = 1e-3, 0.02
# Minimum time between two nodes of the reference [s]; closer nodes are due to rounding.
_MIN_INTERVAL = 1e-9


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Reference along a planner path.

    Attributes
    ----------
    reference
        Timed reference along the path.
    length
        Length of the path from the robot to the end of the path [m].
    deviation
        Maximum distance of the reference from the polyline of the planner [m], without the approach to the path.
    start_distance
        Distance of the robot from the start of the reference [m].
    note
        Note for the result of a goal, for example on a reduced speed; empty if there is no note.
    """

    reference: SplineTrajectory
    length: float
    deviation: float
    start_distance: float
    note: str = ""


def time_poses(
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
    """Create a reference along the poses of a planner, which ends at rest at the position and heading of the last pose.

    The reference starts near the robot with the robot's twist, so that a new path replaces the previous path without a
    stop. It stops at reversals and at turns on the spot. It starts with a turn on the spot if the robot is at
    standstill with another heading than the path, and ends with a turn if the heading of the goal differs from that of
    the path.

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
    _check_poses(poses, settings.max_length)
    poses = remaining_poses(poses, robot)
    parts = split_into_parts(poses, robot, backwards=backwards)
    nodes: list[Nodes] = []
    speed, yaw_rate = twist
    is_standing = abs(speed) < _STANDSTILL_SPEED
    # The path starts with the curvature that the robot drives now.
    bend = 0.0 if is_standing else max(-_MAX_CURVATURE, min(_MAX_CURVATURE, yaw_rate / abs(speed)))
    may_turn = not limits.min_turn_radius
    pose = np.array([*poses[0, :2], robot[2]])
    max_distance = 0.0
    # The robot stops between parts, so only the first part depends on its current motion.
    for index, part in enumerate(parts):
        line, ends, offsets = _smooth_line(part, pose if index == 0 else None, bend, deviation, max_offset)
        max_distance = max(max_distance, float(offsets.max()))
        path = _heading_path(line, ends, part.sense)
        gap = float(wrap_angle(path.heading[0] - pose[2]))
        # The reference starts with the component of the robot's velocity along the path.
        enter = max(0.0, part.sense * speed * math.cos(gap)) if index == 0 else 0.0
        # At the start, bending the path removes a small difference, and a moving robot does not stop for a turn.
        if may_turn and (index or (is_standing and abs(gap) > settings.bendable)) and abs(gap) > _MIN_TURN:
            nodes += _turn_on_the_spot(np.array([*path.points[0], pose[2]]), gap, limits)
        square = squared_speeds(
            path.lengths, path.bend, path.bend_change, limits, math.inf, lateral=True, enter=enter, sense=part.sense
        )
        times, node_poses, rates = time_path(path, square, limits, part.sense)
        # The offsets are given at the points of the line, between which there are several nodes.
        shares, node_shares = np.linspace(0, 1, len(offsets)), np.linspace(0, 1, len(times))
        nodes.append((times, node_poses, rates, np.interp(node_shares, shares, offsets)))
        pose = node_poses[-1]
    gap = float(wrap_angle(poses[-1, 2] - pose[2]))
    if may_turn and abs(gap) > _MIN_TURN:
        nodes += _turn_on_the_spot(np.array([*poses[-1, :2], pose[2]]), gap, limits)
    if not nodes:
        raise ConfigError("path: all poses are at one position, and no turn is needed or allowed")
    reference = _join_nodes(nodes, float(robot[2]), name)
    start = reference.sample([0.0]).pose[0]
    start_distance = float(np.hypot(*(start - robot)[:2]))
    return PlannedPath(reference, sum(part.length for part in parts), max_distance, start_distance)


def _check_poses(poses: FloatArray, max_length: float) -> None:
    if len(poses) < 2:
        raise ConfigError(f"path: it has {len(poses)} poses; give at least two")
    invalid = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if invalid.size:
        raise ConfigError(f"path: pose {invalid[0]} is not finite")
    length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    if length > max_length:
        raise ConfigError(f"path: its length is {length:.3g} m, at most {max_length:g} m: are positions in m?")


def remaining_poses(poses: FloatArray, robot: FloatArray) -> FloatArray:
    """Return the poses (k, 3) of a path (n, 3) from the point nearest to `robot` (3,) to its end.

    The robot has moved along the path since the path was planned.
    """
    step = np.diff(poses[:, :2], axis=0)
    lengths = np.hypot(*step.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    gap = robot[:2] - poses[:-1, :2]
    share = np.clip((gap * step).sum(axis=1) / np.maximum(lengths**2, 1e-12), 0.0, 1.0)
    closest_points = poses[:-1, :2] + share[:, None] * step
    distance = np.hypot(*(closest_points - robot[:2]).T)
    # The path may pass the same position again, so the search is limited to the distance that the robot may have moved.
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


_EndHeadings = tuple[float | None, float | None]


def _smooth_line(
    part: DirectedPart, robot: FloatArray | None, bend: float, deviation: float, max_offset: float
) -> tuple[FloatArray, _EndHeadings, FloatArray]:
    """Fit a smooth line to a part; return its points (m, 2), end directions and distances from the part (m,) [m].

    With the pose `robot` (3,), the line starts at the robot if the part is at most `max_offset` [m] away. It starts
    with the robot's heading if the difference of headings is small enough, and with the curvature `bend` [1/m].
    The distances are 0 along the approach from the robot.
    """
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(part.points, axis=0).T))])
    count = max(_MIN_POINTS, 1 + math.ceil(along[-1] / settings.spacing))
    # `smooth_in_tube` requires evenly spaced points.
    arc_length = np.linspace(0.0, along[-1], count)
    points = np.column_stack([np.interp(arc_length, along, part.points[:, i]) for i in (0, 1)])
    spacing = float(arc_length[1])
    target, start_heading, is_approach = points.copy(), part.start_heading, np.zeros(count, dtype=bool)
    if robot is not None:
        offset = robot[:2] - points[0]
        if np.hypot(*offset) <= max_offset:
            length = min(settings.join, float(along[-1]))
            # The offset decreases quadratically to zero, so the approach joins the path without a kink.
            target += offset * np.maximum(0.0, 1.0 - arc_length / length)[:, None] ** 2
            is_approach, start_heading = arc_length < length, float(robot[2])
    interval = min(count - 1, max(2, round(2 * settings.hairpin_length / spacing)))
    ends: list[float | None] = []
    sections = [target]
    for heading, end, side in ((start_heading, 0, 1), (part.end_heading, count - 1, -1)):
        ends.append(None)
        if heading is None:
            continue
        travel = heading if part.sense > 0 else heading + math.pi
        chord = side * (target[end + side * interval] - target[end])
        if abs(float(wrap_angle(travel - math.atan2(chord[1], chord[0])))) > settings.bendable:
            continue
        ends[-1] = travel
        # The extension continues the line beyond its end, on the arc or straight line with the given direction.
        distance = spacing * np.arange(1, _EXTENSION_POINTS + 1)
        turn = -0.5 * distance * (bend if side > 0 and robot is not None else 0.0)
        direction = travel + turn
        extension = target[end] - side * distance[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        sections = [extension[::-1], *sections] if side > 0 else [*sections, extension]
    line = np.concatenate(sections)
    first = _EXTENSION_POINTS if ends[0] is not None else 0
    # The extensions and both ends are fixed; the points between them are smoothed.
    is_fixed = np.ones(len(line), dtype=bool)
    is_fixed[first + 1 : first + count - 1] = False
    smooth = smooth_in_tube(line, spacing, deviation, settings.smoothing_length, is_fixed)[first : first + count]
    return smooth, (ends[0], ends[1]), np.where(is_approach, 0.0, np.hypot(*(smooth - points).T))


def _heading_path(line: FloatArray, ends: _EndHeadings, sense: int) -> SmoothPath:
    """Return the smooth path along a line, whose heading is that of the robot: opposite to the travel if backwards."""
    path = smooth_path(line, "path", _PIECES, ends)
    if sense > 0:
        return path
    return SmoothPath(path.points, path.heading + math.pi, path.curvature, path.lengths, path.bend, path.bend_change)


def _turn_on_the_spot(pose: FloatArray, angle: float, limits: TrajectoryLimits) -> list[Nodes]:
    """Return the nodes of a turn on the spot by `angle` [rad] from `pose` (3,), at the maximum yaw rate."""
    max_rate = side_of(limits.omega, angle)
    segment = Segment(v=0.0, omega=math.copysign(max_rate, angle), duration=abs(angle) / max_rate)
    return list(turn_nodes([segment], pose, limits))


def _join_nodes(nodes: list[Nodes], heading: float, name: str) -> SplineTrajectory:
    """Join the nodes of consecutive parts to a trajectory with continuous headings that start near `heading` [rad]."""
    time = 0.0
    joined: list[Nodes] = []
    for times, poses, rates, offsets in nodes:
        # Headings of consecutive parts may differ by multiples of 2 pi.
        full_turns = math.tau * round((heading - poses[0, 2]) / math.tau)
        shifted = poses + [0.0, 0.0, full_turns]
        # Rounding can result in two nodes at the same time, of which only the first is used.
        is_later = np.diff(times, prepend=-1.0 if not joined else 0.0) > _MIN_INTERVAL
        joined.append((time + times[is_later], shifted[is_later], rates[is_later], offsets[is_later]))
        time, heading = time + float(times[-1]), float(shifted[-1, 2])
    return SplineTrajectory.through(name, *(np.concatenate(rows) for rows in zip(*joined, strict=True)))
