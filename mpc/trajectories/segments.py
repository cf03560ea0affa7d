"""Conversion of segments (v, omega, duration) to a timed reference, with `timing: stop` or `timing: commanded`.

A segment defines geometry and cruise speed: an arc of length |v| duration and curvature omega / v, driven backwards if
v < 0; a turn on the spot if v = 0; a pause if both are zero. With `commanded`, each twist lasts for its duration. With
`stop`, the robot starts and ends at rest, the geometry is exact, and the acceleration limits require additional time.

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
from diffdrive_mpc.mpc.trajectories.timing import Phase, Timing, between, rest_to_rest

# Minimum rate of a moving segment; a slower twist counts as a pause, since its square would underflow.
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


def lay_segments(
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
    return ArcTrajectory.lay(name, start, [stretch for run in runs(segments) for stretch in time_run(run, limits)])


def lay_commanded(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
) -> ArcTrajectory:
    """Convert `segments` as a script would command them: each twist lasts for its duration, with steps in between.

    Only the start and the end of the drive have ramps within the acceleration limits, which need additional time, since
    a step from rest would contain no path. For arguments and errors see `lay_segments`.
    """
    check_segments(segments, limits, where, exact=True)
    moving = [i for i, segment in enumerate(segments) if segment.cruise]
    stretches = []
    for i, segment in enumerate(segments):
        cruise, length = segment.cruise, segment.cruise * segment.duration
        phases = [Phase(0.0, 0.0, 0.0, segment.duration)]
        if cruise:
            entry, leave = (0.0 if i == end else cruise for end in (moving[0], moving[-1]))
            phases = between(length, cruise, entry, leave, _acceleration([segment], limits))
        stretches.append(PathStretch(*segment.direction, length, phases))
    return ArcTrajectory.lay(name, start, stretches)


def check_segments(segments: Sequence[Segment], limits: TrajectoryLimits, where: str, *, exact: bool = False) -> None:
    """Raise ConfigError if there are no segments or too many, or if a segment exceeds `limits`.

    `where` is the source of the segments. If `exact` is False, only the higher side of a limit is checked, since the
    timing reduces the speed later.
    """
    if not segments:
        raise ConfigError(f"{where}: segments is empty; give at least one {{v, omega, duration}}")
    maximum = load_settings().most_segments
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
    """Group consecutive segments that can be joined without a stop."""
    runs = [[segments[0]]]
    for previous, segment in pairwise(segments):
        if previous.cruise and segment.cruise and _joins(previous, segment):
            runs[-1].append(segment)
        else:
            runs.append([segment])
    return runs


def _joins(first: Segment, second: Segment) -> bool:
    """Return True if the ratio of forward to yaw motion is the same in `first` and `second`."""
    # Only rounding of omega / v is tolerated, since the yaw rate jumps by the difference.
    return all(
        math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12) for a, b in zip(first.direction, second.direction, strict=True)
    )


def time_run(run: Sequence[Segment], limits: TrajectoryLimits) -> list[PathStretch]:
    """Compute the timing of a run from rest to rest."""
    if not run[0].cruise:
        return [PathStretch(0.0, 0.0, 0.0, [Phase(0.0, 0.0, 0.0, segment.duration)]) for segment in run]
    lengths = [segment.cruise * segment.duration for segment in run]
    phases = rest_to_rest(lengths, [segment.cruise for segment in run], _acceleration(run, limits))
    return [
        PathStretch(*segment.direction, length, timing)
        for segment, length, timing in zip(run, lengths, phases, strict=True)
    ]


def slow_down(segments: Sequence[Segment], limits: TrajectoryLimits) -> list[Segment]:
    """Reduce the speed of segments that exceed the lower side of a limit, with a reserve for tracking."""
    slowed = []
    for segment in segments:
        pairs = ((segment.v, limits.v), (segment.omega, limits.omega))
        excess = max((abs(value) / side_of(limit, value) for value, limit in pairs))
        if excess > 1.0:
            factor = excess / load_settings().reach_share
            changed = {"v": segment.v / factor, "omega": segment.omega / factor, "duration": segment.duration * factor}
            slowed.append(segment.model_copy(update=changed))
        else:
            slowed.append(segment)
    return slowed


def _acceleration(run: Sequence[Segment], limits: TrajectoryLimits) -> float:
    """Compute the maximum acceleration of the progress within the limits of all moving segments of `run`."""
    bounds = (limits.v_acceleration, limits.omega_acceleration)
    return min(
        bound / abs(share) for segment in run for share, bound in zip(segment.direction, bounds, strict=True) if share
    )
