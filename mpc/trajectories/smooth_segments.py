"""Smooth timing of segments: clothoids replace jumps of the curvature, so that the robot need not stop there.

The path deviates from the segments by at most a given distance. The robot still stops at cusps and before and after
turns on the spot and pauses, which remain exact. A segment whose radius is below the minimum of the settings counts as
a turn on the spot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.mpc.trajectories.clothoids import Clothoid, Joint, distances, joint, sample_clothoids
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds, time_path
from diffdrive_mpc.mpc.trajectories.segments import Segment, check_segments, runs, slow_down, time_run
from diffdrive_mpc.mpc.trajectories.smooth_path import SmoothPath
from diffdrive_mpc.mpc.trajectories.speed_passport import SpeedCaps
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# Maximum turn between two nodes of a turn on the spot [rad].
_TURN_STEP = 0.05
# Minimum length of an arc between its joints [m].
_MIN_ARC = 1e-9

Nodes = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Nodes of a trajectory: times (n,) [s] since the first node, poses (n, 3) [m, m, rad], time derivatives (n, 3) of the
poses, and distances (n,) from the drawn path [m]."""


def time_smooth_path(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
    smoothing: float | None = None,
    caps: SpeedCaps | None = None,
) -> SplineTrajectory:
    """Convert `segments` to a trajectory of continuous curvature from rest to rest, with a minimum number of stops.

    Parameters
    ----------
    segments, limits, name, start, where
        See `segments.time_segments`; `limits` includes the lateral acceleration.
    smoothing
        Maximum distance from the drawn path [m]; None selects the value of the settings.
    caps
        Maximum speeds by curvature; None for no such limit. With caps, turns on the spot and backward driving are
        rejected.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are no segments or too many, a segment exceeds `limits`, the path is too long, or `caps` contain no
        speed for a turn.
    """
    check_segments(segments, limits, where)
    segments = slow_down(segments, limits)
    distance = load_settings().smoothing if smoothing is None else smoothing
    _check_work(segments, where)
    pose, time = np.asarray(start, dtype=float), 0.0
    node_groups: list[Nodes] = [(np.zeros(1), pose[None], np.zeros((1, 3)), np.zeros(1))]
    for sense, group in groupby(segments, _sense):
        run = list(group)
        if caps is not None and sense <= 0:
            raise ConfigError(
                f"{where}: speed_passport does not cover backward driving and turns on the spot; "
                "drive forwards, or remove it"
            )
        pieces = (_drive_nodes(run, sense, pose, limits, distance, caps),) if sense else turn_nodes(run, pose, limits)
        for times, poses, rates, offsets in pieces:
            if time + float(times[-1]) == time:  # rounding reduces a short phase to zero length
                continue
            node_groups.append((time + times[1:], poses[1:], rates[1:], offsets[1:]))
            time, pose = time + float(times[-1]), poses[-1]
    return SplineTrajectory.through(name, *(np.concatenate(rows) for rows in zip(*node_groups, strict=True)))


def _check_work(segments: Sequence[Segment], where: str) -> None:
    """Raise ConfigError if the path would have too many pieces or joints."""
    settings = load_settings()
    travelling = [(segment, bool(_sense(segment))) for segment in segments]
    pieces = sum(
        (abs(segment.v) / settings.smooth_piece if travels else abs(segment.omega) / _TURN_STEP) * segment.duration
        for segment, travels in travelling
    )
    settings.check_pieces(pieces, where, "split it, or choose another timing")
    # `joint` caches its results, so repeated joints take no time.
    joints = {
        (before.v, before.omega, after.v, after.omega)
        for (before, first), (after, second) in pairwise(travelling)
        if first and second
    }
    if len(joints) > settings.max_joints:
        raise ConfigError(
            f"{where}: {len(joints):,} different joints of segments, at most {settings.max_joints:,} are possible; "
            "split it, or choose another timing"
        )


def _sense(segment: Segment) -> int:
    """Return 1 forwards, -1 backwards, and 0 for a pause or a turn on the spot.

    A segment whose radius is below the minimum of the settings counts as a turn on the spot.
    """
    is_turn = abs(segment.omega) * load_settings().min_turn_radius > abs(segment.v)
    return 0 if is_turn or not segment.cruise else int(math.copysign(1, segment.v))


def turn_nodes(group: Sequence[Segment], pose: FloatArray, limits: TrajectoryLimits) -> Iterator[Nodes]:
    """Yield the nodes of turns on the spot and pauses from `pose` (3,), without smoothing."""
    for stretch in (stretch for run in runs(group) for stretch in time_run(run, limits)):
        for phase in stretch.phases:
            turn = abs(stretch.turn) * phase.duration * (phase.rate + phase.acceleration * phase.duration / 2)
            times = np.linspace(0.0, phase.duration, 1 + max(1, math.ceil(turn / _TURN_STEP)))
            rate = phase.rate + phase.acceleration * times
            progress = phase.offset + times * (phase.rate + phase.acceleration * times / 2)
            poses = integrate_pose(pose, stretch.forward * progress, stretch.turn * progress, 1.0)
            forward = stretch.forward * rate
            rates = np.column_stack([forward * np.cos(poses[:, 2]), forward * np.sin(poses[:, 2]), stretch.turn * rate])
            yield times, poses, rates, np.zeros(times.size)
        pose = integrate_pose(pose, stretch.forward, stretch.turn, stretch.length)


def _drive_nodes(
    run: Sequence[Segment],
    sense: int,
    pose: FloatArray,
    limits: TrajectoryLimits,
    distance: float,
    caps: SpeedCaps | None,
) -> Nodes:
    """Compute the nodes of segments with one direction of travel, from rest to rest."""
    bends = [segment.omega / abs(segment.v) for segment in run]
    lengths = [abs(segment.v) * segment.duration for segment in run]
    # The reach of a joint is at most half of a segment, or the whole segment if the segment has no other joint.
    room = [length / 2 for length in lengths]
    room[0], room[-1] = lengths[0], lengths[-1]
    joints = [joint(*pair, min(spaces), distance) for pair, spaces in zip(pairwise(bends), pairwise(room), strict=True)]
    reaches = [0.0, *(transition.reach for transition in joints), 0.0]
    # Blocks with one maximum speed each: the segments without their joints, and the joints, whose speed is that of the
    # slower segment.
    blocks: list[tuple[tuple[Clothoid, ...], float, Joint | None]] = []
    for i, (segment, bend, length) in enumerate(zip(run, bends, lengths, strict=True)):
        remaining = length - reaches[i] - reaches[i + 1]
        if remaining > _MIN_ARC:
            blocks.append(((Clothoid(remaining, bend, bend),), abs(segment.v), None))
        if i < len(joints) and joints[i].parts:
            blocks.append((joints[i].parts, min(abs(segment.v), abs(run[i + 1].v)), joints[i]))

    spacing = load_settings().smooth_piece
    distances_along: list[FloatArray] = [np.zeros(1)]
    cruises: list[FloatArray] = []
    offsets: list[FloatArray] = [np.zeros(1)]
    joint_distances: dict[Joint, FloatArray] = {}
    for parts, cruise, transition in blocks:
        # Between two stops, at least one moving node is needed.
        min_pieces = 2 if len(blocks) == len(parts) == 1 else 1
        counts = [max(min_pieces, math.ceil(part.length / spacing)) for part in parts]
        along = np.cumsum(np.repeat([part.length / n for part, n in zip(parts, counts, strict=True)], counts))
        distances_along.append(distances_along[-1][-1] + along)
        cruises.append(np.full(along.size, cruise))
        if transition is None:
            offsets.append(np.zeros(along.size))
        else:
            if transition not in joint_distances:
                poses, _ = sample_clothoids(parts, np.append(0.0, along))
                joint_distances[transition] = distances(poses, transition)[1:]
            offsets.append(joint_distances[transition])
    arc_lengths = np.concatenate(distances_along)
    local, curvature = sample_clothoids([part for parts, *_ in blocks for part in parts], arc_lengths)
    # The local path starts in the direction of travel, so a backward path is rotated by half a turn.
    cos, sin = sense * math.cos(pose[2]), sense * math.sin(pose[2])
    points = pose[:2] + local[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    steps, size = np.diff(arc_lengths), np.abs(curvature)
    max_bend, change = np.maximum(size[:-1], size[1:]), np.abs(np.diff(curvature)) / steps
    path = SmoothPath(points, pose[2] + local[:, 2], curvature, steps, max_bend, change)
    speeds = np.concatenate(cruises)
    max_speeds = speeds if caps is None else np.minimum(speeds, caps.speeds_of(max_bend))
    square = squared_speeds(steps, max_bend, change, limits, max_speeds, lateral=True, sense=sense)
    return *time_path(path, square, limits, sense), np.concatenate(offsets)
