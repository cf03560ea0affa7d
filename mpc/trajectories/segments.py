"""Conversion of segments (v, omega, duration) to a timed reference, with `timing: stop` or `timing: commanded`.

A segment defines geometry and cruise speed: an arc of length |v| duration and curvature omega / v, driven backwards if
v < 0; a turn on the spot if v = 0; a pause if v and omega are zero. With `commanded`, each twist lasts for its
duration. With `stop`, the robot starts and ends at rest, the geometry is exact, and the acceleration limits require
additional time.

On an arc omega = curvature * v, so a jump of the curvature causes a jump of omega unless v = 0. With exact geometry and
limited yaw acceleration, the robot must stop between segments of different curvature, at reversals, and before and
after a turn on the spot. Consecutive segments of equal curvature and direction form a run, in which the speed changes
without a stop. On an arc the acceleration is limited to the minimum of the forward limit and the yaw limit divided by
the curvature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.two_sided import side_of, sides_of
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory, PathStretch
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.speed_passport import PassportUse
from diffdrive_mpc.mpc.trajectories.timing import Phase, Timing, rest_to_rest, trapezoid

# Minimum rate of progress of a moving segment; a slower segment counts as a pause, since its square would underflow.
_MIN_RATE = 1e-100


class Segment(StrictModel):
    """Constant twist over a duration, which defines geometry and cruise speed of a section of the path."""

    v: float = Field(description="forward speed [m/s]; negative drives backwards")
    omega: float = Field(description="yaw rate [rad/s]; positive turns left")
    duration: float = Field(gt=0, description="duration at this twist, without the time added for acceleration [s]")

    @property
    def cruise(self) -> float:
        """Rate of progress: the maximum of |v| [m/s] and |omega| [rad/s]; 0 for a pause."""
        rate = max(abs(self.v), abs(self.omega))
        return rate if rate > _MIN_RATE else 0.0

    @property
    def direction(self) -> tuple[float, float]:
        """Signed distance [m] and angle [rad] per unit of progress; (0, 0) for a pause."""
        return (self.v / self.cruise, self.omega / self.cruise) if self.cruise else (0.0, 0.0)


class SegmentFile(StrictModel):
    """Schema of a trajectory file with segments."""

    name: str | None = Field(default=None, description="name in tables and figures; default: name of the file")
    start: tuple[float, float, float] = Field(default=(0.0, 0.0, 0.0), description="start pose x, y [m], theta [rad]")
    segments: list[Segment] = Field(description="segments in order of travel")
    timing: Timing = Field(default="stop", description="timing of the path")
    smoothing: float | None = Field(
        default=None, gt=0, description="maximum distance from the path for timing: smooth [m]; default: settings"
    )
    speed_passport: PassportUse | None = Field(
        default=None, description="speed passport for timing: smooth, which limits the speed for a tolerance"
    )


def time_segments(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
) -> ArcTrajectory:
    """Convert `segments` to a timed trajectory from the pose `start` (3,) [m, m, rad].

    `where` is the source of the segments in error messages.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are no segments or too many, or a segment exceeds `limits`.
    """
    check_segments(segments, limits, where)
    segments = slow_down(segments, limits)
    return ArcTrajectory.chain(name, start, [stretch for run in runs(segments) for stretch in time_run(run, limits)])


def time_commands(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
) -> ArcTrajectory:
    """Convert `segments` to open-loop commands: each twist lasts for its duration, with steps between the twists.

    Only the start and the end of the drive have ramps within the acceleration limits, which require additional time.
    For arguments and errors see `time_segments`.
    """
    check_segments(segments, limits, where, exact=True)
    moving = [i for i, segment in enumerate(segments) if segment.cruise]
    stretches = []
    for i, segment in enumerate(segments):
        cruise, length = segment.cruise, segment.cruise * segment.duration
        phases = [Phase(0.0, 0.0, 0.0, segment.duration)]
        if cruise:
            entry_speed, exit_speed = (0.0 if i == end else cruise for end in (moving[0], moving[-1]))
            phases = trapezoid(length, cruise, entry_speed, exit_speed, _acceleration([segment], limits))
        stretches.append(PathStretch(*segment.direction, length, phases))
    return ArcTrajectory.chain(name, start, stretches)


def check_segments(segments: Sequence[Segment], limits: TrajectoryLimits, where: str, *, exact: bool = False) -> None:
    """Raise ConfigError if there are no segments or too many, or if a segment exceeds `limits`.

    `where` is the source of the segments in the message. If `exact` is False, a two-sided limit is checked only against
    its higher side, since `slow_down` later reduces the speed to the lower side.
    """
    if not segments:
        raise ConfigError(f"{where}: segments is empty; give at least one {{v, omega, duration}}")
    maximum = load_settings().max_segments
    if len(segments) > maximum:
        raise ConfigError(f"{where}: {len(segments):,} segments, at most {maximum:,}; join segments, or split the file")
    for i, segment in enumerate(segments):
        for key, unit in (("v", "m/s"), ("omega", "rad/s")):
            value = getattr(segment, key)
            limit = getattr(limits, key)
            bound = side_of(limit, value) if exact else max(sides_of(limit))
            if abs(value) > bound:
                raise BeyondLimitError(
                    f"{where}: segments.{i}.{key} = {value:g} {unit} is beyond the limit of {bound:g} {unit}; lower it"
                )


def runs(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Group consecutive segments that the robot can drive without a stop between them."""
    runs = [[segments[0]]]
    for previous, segment in pairwise(segments):
        if previous.cruise and segment.cruise and _has_same_direction(previous, segment):
            runs[-1].append(segment)
        else:
            runs.append([segment])
    return runs


def _has_same_direction(first: Segment, second: Segment) -> bool:
    """Return True if curvature and direction of travel are the same in `first` and `second`."""
    # Only rounding of omega / v is tolerated, since a difference would be a jump of the yaw rate.
    return all(
        math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12) for a, b in zip(first.direction, second.direction, strict=True)
    )


def time_run(run: Sequence[Segment], limits: TrajectoryLimits) -> list[PathStretch]:
    """Compute the timing of a run, see `runs`, from rest to rest."""
    if not run[0].cruise:
        return [PathStretch(0.0, 0.0, 0.0, [Phase(0.0, 0.0, 0.0, segment.duration)]) for segment in run]
    lengths = [segment.cruise * segment.duration for segment in run]
    phases = rest_to_rest(lengths, [segment.cruise for segment in run], _acceleration(run, limits))
    return [
        PathStretch(*segment.direction, length, timing)
        for segment, length, timing in zip(run, lengths, phases, strict=True)
    ]


def slow_down(segments: Sequence[Segment], limits: TrajectoryLimits) -> list[Segment]:
    """Reduce the speed of segments that exceed their side of a two-sided limit, with a margin for tracking."""
    result = []
    for segment in segments:
        pairs = ((segment.v, limits.v), (segment.omega, limits.omega))
        excess = max((abs(value) / side_of(limit, value) for value, limit in pairs))
        if excess > 1.0:
            factor = excess / load_settings().reach_share
            slower = {"v": segment.v / factor, "omega": segment.omega / factor, "duration": segment.duration * factor}
            result.append(segment.model_copy(update=slower))
        else:
            result.append(segment)
    return result


def _acceleration(run: Sequence[Segment], limits: TrajectoryLimits) -> float:
    """Compute the maximum acceleration of the progress within the limits of all moving segments of `run`."""
    bounds = (limits.v_acceleration, limits.omega_acceleration)
    return min(
        bound / abs(share) for segment in run for share, bound in zip(segment.direction, bounds, strict=True) if share
    )
