"""A planner's path as a timed reference: cut at the robot, smoothed, timed, with turns on the spot if needed."""

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
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds, timed
from diffdrive_mpc.mpc.trajectories.planned.tube import least_bent, load_settings
from diffdrive_mpc.mpc.trajectories.segments import Segment
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath, smooth_path
from diffdrive_mpc.mpc.trajectories.smooth_segments import Nodes, turned
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# Interpretation of a planner's poses: parts driven forwards, backwards, and turns.


@dataclass(frozen=True, eq=False)
class DirectedPart:
    """A part of a path that is driven in one direction, from one place where the robot stops to the next.

    Attributes
    ----------
    points
        (k, 2), k >= 2, no two neighbours at one place [m].
    sense
        1 forwards, -1 backwards.
    first, last
        Heading that the poses state at its ends [rad]; None where they state none.
    """

    points: FloatArray
    sense: int
    first: float | None
    last: float | None

    @property
    def length(self) -> float:
        """[m]."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


def read_runs(poses: FloatArray, robot: FloatArray, *, backwards: bool = True) -> list[DirectedPart]:
    """Cut a path where its direction changes.

    A part whose poses point against the travel is driven backwards; poses that stay at one place and turn are a turn on
    the spot. Some planners state no headings but the last: all others are 0, exactly. They are ignored if the travel,
    or the robot, contradicts that; such a path is driven forwards.

    Parameters
    ----------
    poses
        (n, 3) x, y [m], theta [rad], finite.
    robot
        (3,) pose of the robot.
    backwards
        Whether a part may be driven backwards.

    Returns
    -------
    list of Run
        Empty where all poses are at one place.
    """
    settings = load_settings()
    apart = np.hypot(*np.diff(poses[:, :2], axis=0).T) > settings.coincident
    firsts = np.concatenate([[0], np.flatnonzero(apart) + 1])
    lasts = np.concatenate([firsts[1:] - 1, [len(poses) - 1]])
    if firsts.size < 2:
        return []
    points = poses[firsts, :2]
    # The place that ends a path is its last pose's.
    points[-1] = poses[-1, :2]
    arriving, leaving = poses[firsts, 2], poses[lasts, 2]
    step = np.diff(points, axis=0)
    lengths, travel = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0])
    agree = np.cos(leaving[:-1] - travel)
    stated = _stated(poses, agree, robot)
    senses = np.where(np.abs(agree) < settings.sideways, 0, np.sign(agree)).astype(int)
    if not (stated and backwards):
        senses = np.ones_like(senses)
    senses = _steady(senses, lengths, settings.least_run)
    turned = np.abs(wrap_angle(leaving - arriving)) > settings.bendable if stated else np.zeros(len(points), dtype=bool)
    cuts = [0, *(i for i in range(1, len(lengths)) if senses[i] != senses[i - 1] or turned[i]), len(lengths)]
    runs: list[DirectedPart] = []
    for start, end in pairwise(cuts):
        first = float(leaving[start]) if stated else None
        last = float(arriving[end]) if stated or end == len(lengths) else None
        runs += _without_hairpins(DirectedPart(points[start : end + 1], int(senses[start]), first, last))
    most = settings.turns_allowed + settings.turns_per_metre * float(lengths.sum())
    if len(runs) - 1 > most:
        raise ConfigError(
            f"path: it turns back {len(runs) - 1} times in {lengths.sum():.2f} m; smooth it, or plan another one"
        )
    return runs


def _stated(poses: FloatArray, agree: FloatArray, robot: FloatArray) -> bool:
    """Return True if the headings before the last carry information."""
    if np.any(np.abs(poses[:-1, 2]) > 1e-9):
        return True
    sideways = bool(np.any(np.abs(agree) < load_settings().sideways))
    return not sideways and math.cos(float(robot[2])) > load_settings().sideways


def _steady(senses: FloatArray, lengths: FloatArray, least: float) -> FloatArray:
    """Filter senses (m,) so that each lasts for `least` [m]; a pose without a sense keeps the previous one."""
    known = np.flatnonzero(senses)
    steady = (
        np.ones_like(senses)
        if not known.size
        else senses[known[np.searchsorted(known[1:], np.arange(senses.size), side="right")]]
    )
    edges = [0, *(np.flatnonzero(np.diff(steady)) + 1).tolist(), steady.size]
    for start, end in pairwise(edges):
        if lengths[start:end].sum() < least:
            steady[start:end] = steady[start - 1] if start else steady[min(end, steady.size - 1)]
    return np.asarray(steady)


def _without_hairpins(run: DirectedPart) -> list[DirectedPart]:
    """Split a run where the path turns back on itself."""
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    reach = settings.hairpin_length

    def place(s: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(s, along, run.points[:, i]) for i in (0, 1)])

    inside = np.flatnonzero((along > settings.least_run) & (along < along[-1] - settings.least_run))
    vertex = run.points[inside]
    before, after = vertex - place(along[inside] - reach), place(along[inside] + reach) - vertex
    turn = np.abs(np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1)))
    # Next to a reversal, the paths to it and from it cancel, so the chords are longest there.
    sharpness = np.hypot(*before.T) * np.hypot(*after.T)
    cuts: list[int] = []
    for i in sorted(np.flatnonzero(turn > settings.hairpin), key=lambda i: -sharpness[i]):
        cut = int(inside[i])
        index = bisect(cuts, cut)
        # Only its neighbours can be too near.
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
# Of a smoothed line that is to bend at all.
_LEAST_POINTS = 8
# Points beyond an end that define the direction of a line; curvature there at most [1/m].
_BEYOND = 3
_TIGHTEST = 3.0
# Turn below which it counts as rounding [rad], and speed below which the robot stands [m/s].
_NO_TURN, _STANDING = 1e-3, 0.02
_AT_ONCE = 1e-9  # [s]


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Reference laid along a path.

    Attributes
    ----------
    reference
        Reference to track.
    length
        Length of the path from the robot on [m].
    deviation
        Maximum distance of the reference from the planner's line [m], without the approach to the line.
    begins
        Distance of the robot from the start of the reference [m].
    note
        Remark for the result of a goal, such as a reduced speed; empty if there is none.
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
    beside: float,
    backwards: bool = True,
    name: str = "path",
) -> PlannedPath:
    """Lay a reference along a planner's poses, to rest at the last of them, heading included.

    It starts at the robot's place along the path with the robot's twist, so that a new path replaces another without a
    stop. It stops at reversals and at turns on the spot: before the path if the robot stands with another heading, and
    at its end if the goal has another heading than the path.

    Parameters
    ----------
    poses
        (n, 3), n >= 2: x, y [m], theta [rad].
    limits
        Speeds and accelerations; with a least turn radius nothing turns on the spot.
    robot
        (3,) its pose, in the frame of the poses.
    twist
        Forward speed [m/s] and yaw rate [rad/s] of the robot.
    deviation
        Largest distance between the reference and the planner's line [m].
    beside
        A robot that is no further beside the path is led onto it by the path itself [m].
    backwards
        Whether parts whose poses point against the travel are driven backwards.
    name
        Name of the reference.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are too few poses, one is not finite, the path is absurdly long or jagged, or all poses are at one
        place and the robot may not turn on the spot.
    """
    settings = load_settings()
    _check(poses, settings.longest)
    poses = poses_left(poses, robot)
    runs = read_runs(poses, robot, backwards=backwards)
    nodes: list[Nodes] = []
    speed, yaw_rate = twist
    standing = abs(speed) < _STANDING
    bend = 0.0 if standing else max(-_TIGHTEST, min(_TIGHTEST, yaw_rate / abs(speed)))
    may_turn = not limits.min_turn_radius
    pose = np.array([*poses[0, :2], robot[2]])
    off = 0.0
    for index, run in enumerate(runs):
        line, ends, drawn = _smoothed(run, pose if index == 0 else None, bend, deviation, beside)
        off = max(off, float(drawn.max()))
        path = _facing(line, ends, run.sense)
        gap = float(wrap_angle(path.heading[0] - pose[2]))
        begins = max(0.0, run.sense * speed * math.cos(gap)) if index == 0 else 0.0
        if may_turn and (index or (standing and abs(gap) > settings.bendable)) and abs(gap) > _NO_TURN:
            nodes += _turn(np.array([*path.points[0], pose[2]]), gap, limits)
        square = squared_speeds(
            path.lengths, path.bend, path.bend_change, limits, math.inf, lateral=True, enter=begins, sense=run.sense
        )
        times, laid, rates = timed(path, square, limits, run.sense)
        nodes.append(
            (times, laid, rates, np.interp(np.linspace(0, 1, len(times)), np.linspace(0, 1, len(drawn)), drawn))
        )
        pose = laid[-1]
    gap = float(wrap_angle(poses[-1, 2] - pose[2]))
    if may_turn and abs(gap) > _NO_TURN:
        nodes += _turn(np.array([*poses[-1, :2], pose[2]]), gap, limits)
    if not nodes:
        raise ConfigError("path: all of its poses are at one place, and there is nothing to turn there")
    reference = _joined(nodes, float(robot[2]), name)
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
        raise ConfigError(f"path: it is {length:.3g} m long, the longest is {longest:g} m: are places in m?")


def poses_left(poses: FloatArray, robot: FloatArray) -> FloatArray:
    """Return the poses (n, 3) ahead of a robot at (3,) that has driven on since the path was planned."""
    step = np.diff(poses[:, :2], axis=0)
    lengths = np.hypot(*step.T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    gap = robot[:2] - poses[:-1, :2]
    share = np.clip((gap * step).sum(axis=1) / np.maximum(lengths**2, 1e-12), 0.0, 1.0)
    feet = poses[:-1, :2] + share[:, None] * step
    distance = np.hypot(*(feet - robot[:2]).T)
    # Not further than it can have come: the path may come by here once more.
    near = along[:-1] <= 2.0 * float(np.hypot(*(robot - poses[0])[:2])) + load_settings().spacing
    # Nor beyond a reversal.
    back = np.flatnonzero((step[1:] * step[:-1]).sum(axis=1) < 0)
    if back.size:
        near[back[0] + 1 :] = False
    nearest = int(np.argmin(np.where(near, distance, np.inf)))
    if nearest == 0 and share[0] == 0.0:
        return poses
    first = np.array([*feet[nearest], poses[nearest, 2]])
    return np.concatenate([first[None], poses[nearest + 1 :]])


_Ends = tuple[float | None, float | None]


def _smoothed(
    run: DirectedPart, robot: FloatArray | None, bend: float, deviation: float, beside: float
) -> tuple[FloatArray, _Ends, FloatArray]:
    """Fit the least bent line (m, 2) along a run; return it with its ends and its distance from the run (m,) [m].

    With `robot` (3,) the line begins there, if it is no further than `beside` [m] from where the run begins, and along
    its heading, if the line can bend so far, with the curvature `bend` [1/m] that the robot drives.
    """
    settings = load_settings()
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(run.points, axis=0).T))])
    count = max(_LEAST_POINTS, 1 + math.ceil(along[-1] / settings.spacing))
    arc_length = np.linspace(0.0, along[-1], count)
    points = np.column_stack([np.interp(arc_length, along, run.points[:, i]) for i in (0, 1)])
    spacing = float(arc_length[1])
    wanted, first, led = points.copy(), run.first, np.zeros(count, dtype=bool)
    if robot is not None:
        offset = robot[:2] - points[0]
        if np.hypot(*offset) <= beside:
            length = min(settings.join, float(along[-1]))
            wanted += offset * np.maximum(0.0, 1.0 - arc_length / length)[:, None] ** 2
            led, first = arc_length < length, float(robot[2])
    look = min(count - 1, max(2, round(2 * settings.hairpin_length / spacing)))
    ends: list[float | None] = []
    parts = [wanted]
    for heading, end, side in ((first, 0, 1), (run.last, count - 1, -1)):
        ends.append(None)
        if heading is None:
            continue
        travel = heading if run.sense > 0 else heading + math.pi
        chord = side * (wanted[end + side * look] - wanted[end])
        if abs(float(wrap_angle(travel - math.atan2(chord[1], chord[0])))) > settings.bendable:
            continue
        ends[-1] = travel
        # Points beyond the end, on the arc or straight line to it, from which the line continues.
        beyond = spacing * np.arange(1, _BEYOND + 1)
        turn = -0.5 * beyond * (bend if side > 0 and robot is not None else 0.0)
        direction = travel + turn
        more = wanted[end] - side * beyond[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        parts = [more[::-1], *parts] if side > 0 else [*parts, more]
    line = np.concatenate(parts)
    before = _BEYOND if ends[0] is not None else 0
    pinned = np.ones(len(line), dtype=bool)
    pinned[before + 1 : before + count - 1] = False
    smooth = least_bent(line, spacing, deviation, settings.smoothing_length, pinned)[before : before + count]
    return smooth, (ends[0], ends[1]), np.where(led, 0.0, np.hypot(*(smooth - points).T))


def _facing(line: FloatArray, ends: _Ends, sense: int) -> SmoothPath:
    """Return the smooth path along a line, with the robot's heading instead of the direction of travel."""
    path = smooth_path(line, "path", _PIECES, ends)
    if sense > 0:
        return path
    return SmoothPath(path.points, path.heading + math.pi, path.curvature, path.lengths, path.bend, path.bend_change)


def _turn(pose: FloatArray, angle: float, limits: TrajectoryLimits) -> list[Nodes]:
    fastest = side_of(limits.omega, angle)
    segment = Segment(v=0.0, omega=math.copysign(fastest, angle), duration=abs(angle) / fastest)
    return list(turned([segment], pose, limits))


def _joined(nodes: list[Nodes], heading: float, name: str) -> SplineTrajectory:
    """Join parts that begin where the previous one ends, apart from whole turns; the first starts near `heading`."""
    time = 0.0
    parts: list[Nodes] = []
    for times, poses, rates, drawn in nodes:
        whole = math.tau * round((heading - poses[0, 2]) / math.tau)
        shifted = poses + [0.0, 0.0, whole]
        # Of two nodes at one time, as rounding leaves them in a short turn, and where parts meet, the first is enough.
        new = np.diff(times, prepend=-1.0 if not parts else 0.0) > _AT_ONCE
        parts.append((time + times[new], shifted[new], rates[new], drawn[new]))
        time, heading = time + float(times[-1]), float(shifted[-1, 2])
    return SplineTrajectory.through(name, *(np.concatenate(rows) for rows in zip(*parts, strict=True)))
