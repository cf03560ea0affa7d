"""Conversion of a planner's path to a timed reference from the robot's position, with turns on the spot if needed."""

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

# Interpretation of a planner's poses: parts driven forwards, backwards, and turns.


@dataclass(frozen=True, eq=False)
class DirectedPart:
    """Part of a path that is driven in one direction between two stops.

    Attributes
    ----------
    points
        (k, 2), k >= 2, x, y [m]; successive points differ.
    sense
        1 forwards, -1 backwards.
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
    """Divide a path into parts where its direction changes.

    A part whose poses point against the travel is driven backwards; poses at one position with different headings are a
    turn on the spot. Some planners set only the last heading, and all others to exactly 0. Headings of 0 are ignored if
    they contradict the travel or the robot; such a path is driven forwards.

    Parameters
    ----------
    poses
        (n, 3) x, y [m], theta [rad], finite.
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
    apart = np.hypot(*np.diff(poses[:, :2], axis=0).T) > settings.coincident
    firsts = np.concatenate([[0], np.flatnonzero(apart) + 1])
    lasts = np.concatenate([firsts[1:] - 1, [len(poses) - 1]])
    if firsts.size < 2:
        return []
    points = poses[firsts, :2]
    # A path ends at the position of its last pose.
    points[-1] = poses[-1, :2]
    arriving, leaving = poses[firsts, 2], poses[lasts, 2]
    step = np.diff(points, axis=0)
    lengths, travel = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    alignment = np.cos(leaving[:-1] - travel)
    has_headings = _has_headings(poses, alignment, robot)
    senses = np.where(np.abs(alignment) < settings.sideways, 0, np.sign(alignment)).astype(int)
    if not (has_headings and backwards):
        senses = np.ones_like(senses)
    senses = _filter_senses(senses, lengths, settings.least_run)
    turns = np.abs(wrap_angle(leaving - arriving)) > (settings.bendable if has_headings else np.inf)
    cuts = [0, *(i for i in range(1, len(lengths)) if senses[i] != senses[i - 1] or turns[i]), len(lengths)]
    runs: list[DirectedPart] = []
    for start, end in pairwise(cuts):
        first = float(leaving[start]) if has_headings else None
        last = float(arriving[end]) if has_headings or end == len(lengths) else None
        runs += _split_at_hairpins(DirectedPart(points[start : end + 1], int(senses[start]), first, last))
    max_reversals = settings.turns_allowed + settings.turns_per_metre * float(lengths.sum())
    if len(runs) - 1 > max_reversals:
        raise ConfigError(
            f"path: it turns back {len(runs) - 1} times in {lengths.sum():.2f} m; smooth it, or plan another path"
        )
    return runs


def _has_headings(poses: FloatArray, alignment: FloatArray, robot: FloatArray) -> bool:
    """Return True if the headings before the last one are valid, not zeros of a planner without headings."""
    if np.any(np.abs(poses[:-1, 2]) > 1e-9):
        return True
    sideways = bool(np.any(np.abs(alignment) < load_settings().sideways))
    return not sideways and math.cos(float(robot[2])) > load_settings().sideways


def _filter_senses(senses: FloatArray, lengths: FloatArray, min_length: float) -> FloatArray:
    """Filter senses (m,) so that each lasts for `min_length` [m]; a pose without a sense gets the previous one."""
    known = np.flatnonzero(senses)
    steady = (
        np.ones_like(senses)
        if not known.size
        else senses[known[np.searchsorted(known[1:], np.arange(senses.size), side="right")]]
    )
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), steady.size]
    for start, end in pairwise(edges):
        if lengths[start:end].sum() < min_length:
            steady[start:end] = steady[start - 1] if start else steady[min(end, steady.size - 1)]
    return np.asarray(steady)


def _split_at_hairpins(run: DirectedPart) -> list[DirectedPart]:
    """Split a part where the path turns back on itself."""
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    reach = settings.hairpin_length

    def point_at(s: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(s, along, run.points[:, i]) for i in (0, 1)])

    inside = np.flatnonzero((along > settings.least_run) & (along < along[-1] - settings.least_run))
    vertex = run.points[inside]
    before, after = vertex - point_at(along[inside] - reach), point_at(along[inside] + reach) - vertex
    turn = np.abs(np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1)))
    # Near a reversal the paths to it and from it cancel, so the chords are longest at the reversal itself.
    sharpness = np.hypot(*before.T) * np.hypot(*after.T)
    cuts: list[int] = []
    for i in sorted(np.flatnonzero(turn > settings.hairpin), key=lambda i: -sharpness[i]):
        cut = int(inside[i])
        index = bisect(cuts, cut)
        # Only the adjacent cuts can be too near.
        near = cuts[max(0, index - 1) : index + 1]
        if all(abs(along[cut] - along[rival]) > reach for rival in near):
            cuts.insert(index, cut)
    edges = [0, *cuts, len(run.points) - 1]
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
# Number of points beyond an end that define the direction of a line; maximum curvature of these points [1/m].
_BEYOND = 3
_MAX_CURVATURE = 3.0
# Minimum turn on the spot, less being rounding [rad], and speed below which the robot is at standstill [m/s].
_NO_TURN, _STANDING = 1e-3, 0.02
_MIN_INTERVAL = 1e-9  # [s]


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Reference along a planner's path.

    Attributes
    ----------
    reference
        Reference to track.
    length
        Length of the path from the robot to its end [m].
    deviation
        Maximum distance of the reference from the planner's line [m], without the approach to the line.
    begins
        Distance of the robot from the start of the reference [m].
    note
        Note for the result of a goal, such as a reduced speed; empty if there is none.
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
    """Create a reference along a planner's poses, which ends at rest at the last pose, including its heading.

    It starts at the robot's position along the path with the robot's twist, so that a new path replaces the previous
    one without a stop. It stops at reversals and at turns on the spot: before the path if the robot at standstill has
    another heading, and at the end if the heading of the goal differs from that of the path.

    Parameters
    ----------
    poses
        (n, 3), n >= 2: x, y [m], theta [rad].
    limits
        Limits of speed and acceleration; with a minimum turn radius there are no turns on the spot.
    robot
        (3,) pose of the robot in the frame of the poses.
    twist
        Forward speed [m/s] and yaw rate [rad/s] of the robot.
    deviation
        Maximum distance between the reference and the planner's line [m].
    max_offset
        Maximum distance of the robot from the path at which the reference starts at the robot [m].
    backwards
        True to drive parts backwards whose poses point against the travel.
    name
        Name of the reference.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are too few poses, a pose is not finite, the path is too long or has too many reversals, or all poses
        are at one position and no turn is needed or allowed there.
    """
    settings = load_settings()
    _check(poses, settings.longest)
    poses = remaining_poses(poses, robot)
    runs = read_runs(poses, robot, backwards=backwards)
    nodes: list[Nodes] = []
    speed, yaw_rate = twist
    standing = abs(speed) < _STANDING
    bend = 0.0 if standing else max(-_MAX_CURVATURE, min(_MAX_CURVATURE, yaw_rate / abs(speed)))
    may_turn = not limits.min_turn_radius
    pose = np.array([*poses[0, :2], robot[2]])
    off = 0.0
    for index, run in enumerate(runs):
        line, ends, drawn = _smooth_line(run, pose if index == 0 else None, bend, deviation, max_offset)
        off = max(off, float(drawn.max()))
        path = _heading_path(line, ends, run.sense)
        gap = float(wrap_angle(path.heading[0] - pose[2]))
        begins = max(0.0, run.sense * speed * math.cos(gap)) if index == 0 else 0.0
        if may_turn and (index or (standing and abs(gap) > settings.bendable)) and abs(gap) > _NO_TURN:
            nodes += _turn(np.array([*path.points[0], pose[2]]), gap, limits)
        square = squared_speeds(
            path.lengths, path.bend, path.bend_change, limits, math.inf, lateral=True, enter=begins, sense=run.sense
        )
        times, laid, rates = time_path(path, square, limits, run.sense)
        nodes.append(
            (times, laid, rates, np.interp(np.linspace(0, 1, len(times)), np.linspace(0, 1, len(drawn)), drawn))
        )
        pose = laid[-1]
    gap = float(wrap_angle(poses[-1, 2] - pose[2]))
    if may_turn and abs(gap) > _NO_TURN:
        nodes += _turn(np.array([*poses[-1, :2], pose[2]]), gap, limits)
    if not nodes:
        raise ConfigError("path: all poses are at one position, and no turn is needed or allowed there")
    reference = _join(nodes, float(robot[2]), name)
    start = reference.sample([0.0]).pose[0]
    return PlannedPath(reference, sum(run.length for run in runs), off, float(np.hypot(*(start - robot)[:2])))


def _check(poses: FloatArray, longest: float) -> None:
    if len(poses) < 2:
        raise ConfigError(f"path: it has {len(poses)} poses; give at least two")
    wrong = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if wrong.size:
        raise ConfigError(f"path: pose {wrong[0]} is not finite")
    length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    if length > longest:
        raise ConfigError(f"path: its length is {length:.3g} m, at most {longest:g} m: are positions in m?")


def remaining_poses(poses: FloatArray, robot: FloatArray) -> FloatArray:
    """Return the poses (n, 3) ahead of `robot` (3,), which has moved since the path was planned."""
    step = np.diff(poses[:, :2], axis=0)
    lengths = np.hypot(*step.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    gap = robot[:2] - poses[:-1, :2]
    share = np.clip((gap * step).sum(axis=1) / np.maximum(lengths**2, 1e-12), 0.0, 1.0)
    feet = poses[:-1, :2] + share[:, None] * step
    distance = np.hypot(*(feet - robot[:2]).T)
    # The search is limited to the distance that the robot can have driven, since the path may pass this position again.
    near = along[:-1] <= 2.0 * float(np.hypot(*(robot - poses[0])[:2])) + load_settings().spacing
    # The search also ends at a reversal.
    back = np.flatnonzero((step[1:] * step[:-1]).sum(axis=1) < 0)
    if back.size:
        near[back[0] + 1 :] = False
    nearest = int(np.argmin(np.where(near, distance, np.inf)))
    if nearest == 0 and share[0] == 0.0:
        return poses
    first = np.array([*feet[nearest], poses[nearest, 2]])
    return np.concatenate([first[None], poses[nearest + 1 :]])


_Ends = tuple[float | None, float | None]


def _smooth_line(
    run: DirectedPart, robot: FloatArray | None, bend: float, deviation: float, max_offset: float
) -> tuple[FloatArray, _Ends, FloatArray]:
    """Fit a smooth line (m, 2) along a part; return it with its end headings and its distances from the part (m,) [m].

    With `robot` (3,) the line starts at the robot if the part starts at most `max_offset` [m] from it. It starts with
    the robot's heading if the line can bend accordingly, and with the robot's current curvature `bend` [1/m].
    """
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    count = max(_MIN_POINTS, 1 + math.ceil(along[-1] / settings.spacing))
    arc_length = np.linspace(0.0, along[-1], count)
    points = np.column_stack([np.interp(arc_length, along, run.points[:, i]) for i in (0, 1)])
    spacing = float(arc_length[1])
    target, first, is_approach = points.copy(), run.first, np.zeros(count, dtype=bool)
    if robot is not None:
        offset = robot[:2] - points[0]
        if np.hypot(*offset) <= max_offset:
            length = min(settings.join, float(along[-1]))
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
        # Points beyond the end, on the arc or straight line that the line continues.
        beyond = spacing * np.arange(1, _BEYOND + 1)
        turn = -0.5 * beyond * (bend if side > 0 and robot is not None else 0.0)
        direction = travel + turn
        more = target[end] - side * beyond[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        parts = [more[::-1], *parts] if side > 0 else [*parts, more]
    line = np.concatenate(parts)
    before = _BEYOND if ends[0] is not None else 0
    pinned = np.ones(len(line), dtype=bool)
    pinned[before + 1 : before + count - 1] = False
    smooth = smooth_in_tube(line, spacing, deviation, settings.smoothing_length, pinned)[before : before + count]
    return smooth, (ends[0], ends[1]), np.where(is_approach, 0.0, np.hypot(*(smooth - points).T))


def _heading_path(line: FloatArray, ends: _Ends, sense: int) -> SmoothPath:
    """Return the smooth path along a line, with the robot's heading instead of the direction of travel."""
    path = smooth_path(line, "path", _PIECES, ends)
    if sense > 0:
        return path
    return SmoothPath(path.points, path.heading + math.pi, path.curvature, path.lengths, path.bend, path.bend_change)


def _turn(pose: FloatArray, angle: float, limits: TrajectoryLimits) -> list[Nodes]:
    fastest = side_of(limits.omega, angle)
    segment = Segment(v=0.0, omega=math.copysign(fastest, angle), duration=abs(angle) / fastest)
    return list(turn_nodes([segment], pose, limits))


def _join(nodes: list[Nodes], heading: float, name: str) -> SplineTrajectory:
    """Join consecutive parts, whose headings may differ by whole turns; the first part starts near `heading`."""
    time = 0.0
    parts: list[Nodes] = []
    for times, poses, rates, drawn in nodes:
        whole = math.tau * round((heading - poses[0, 2]) / math.tau)
        shifted = poses + [0.0, 0.0, whole]
        # Of two nodes at the same time, from rounding in a short turn or at the joint of two parts, the first is kept.
        new = np.diff(times, prepend=-1.0 if not parts else 0.0) > _MIN_INTERVAL
        parts.append((time + times[new], shifted[new], rates[new], drawn[new]))
        time, heading = time + float(times[-1]), float(shifted[-1, 2])
    return SplineTrajectory.through(name, *(np.concatenate(rows) for rows in zip(*parts, strict=True)))
