"""Sequences of (v, omega, duration), turned into a timed reference: what `timing: stop` and `commanded` mean.

A segment fixes geometry and cruise speed: an arc of length |v| duration and curvature omega / v, driven backwards where
v < 0; a turn on the spot where v = 0; a wait where both are zero. With `commanded` each twist lasts for its duration.
With `stop` a robot starts and ends at rest, the geometry is exact, and time is added as the acceleration limits
require.

On an arc omega = curvature * v, so where the curvature jumps, omega would jump too unless v = 0 there. With exact
geometry and bounded yaw acceleration, the robot must stop between segments of different curvature, at reversals, and
around a turn on the spot. Consecutive segments of equal curvature and direction form one run, within which the speed
goes from one cruise value to the next without a stop. On an arc the acceleration is bounded by the smaller of the
forward limit and the yaw limit over the curvature.
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

# A slower twist is a wait: over any duration it leads nowhere, and its square would underflow.
_STILL = 1e-100


class Segment(StrictModel):
    """Constant twist over a duration: the geometry and cruise speed of one piece of path."""

    v: float = Field(description="forward speed [m/s]; negative drives backwards")
    omega: float = Field(description="yaw rate [rad/s]; positive turns left")
    duration: float = Field(gt=0, description="duration at that twist, before time is added for acceleration [s]")

    @property
    def cruise(self) -> float:
        """Rate of progress: the larger of |v| [m/s] and |omega| [rad/s]; 0 for a wait."""
        rate = max(abs(self.v), abs(self.omega))
        return rate if rate > _STILL else 0.0

    @property
    def direction(self) -> tuple[float, float]:
        """Metres driven and radians turned per unit of progress, with sign; (0, 0) for a wait."""
        return (self.v / self.cruise, self.omega / self.cruise) if self.cruise else (0.0, 0.0)


class SegmentFile(StrictModel):
    """Schema of a trajectory file with segments."""

    name: str | None = Field(default=None, description="name for tables and figures; default: name of the file")
    start: tuple[float, float, float] = Field(default=(0.0, 0.0, 0.0), description="start pose x, y [m], theta [rad]")
    segments: list[Segment] = Field(description="segments in the order in which they are driven")
    timing: Timing = Field(default="stop", description="how speed is laid over the path")
    smoothing: float | None = Field(
        default=None, gt=0, description="timing: smooth keeps within this distance of the path [m]; default: settings"
    )
    speed_passport: PassportUse | None = Field(
        default=None, description="timing: smooth is no faster than this passport allows for a tolerance"
    )


def lay_segments(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
) -> ArcTrajectory:
    """Turn `segments` into a timed trajectory from the pose `start` (3,) [m, m, rad].

    `where` names the source of the segments in error messages.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no segment, or too many, or one is faster than `limits`.
    """
    check_segments(segments, limits, where)
    segments = slowed(segments, limits)
    return ArcTrajectory.lay(name, start, [stretch for run in runs(segments) for stretch in timed_run(run, limits)])


def lay_commanded(
    segments: Sequence[Segment],
    limits: TrajectoryLimits,
    *,
    name: str,
    start: Sequence[float] = (0.0, 0.0, 0.0),
    where: str = "trajectory",
) -> ArcTrajectory:
    """Take `segments` as a script would command them: each twist for its duration, with steps from one to the next.

    Only at the start and at the end of all driving the twist follows a ramp within the accelerations, for which time is
    added: a step from rest would contain no path. Arguments and errors are those of `lay_segments`.
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
    """Raise ConfigError for no segment, too many, or one faster than `limits`; `where` names their source.

    Timing reduces speeds beyond the smaller side of a limit, unless speeds are `exact`.
    """
    if not segments:
        raise ConfigError(f"{where}: segments is empty; give at least one {{v, omega, duration}}")
    most = load_settings().most_segments
    if len(segments) > most:
        raise ConfigError(f"{where}: {len(segments):,} segments, at most {most:,}; join some, or split the file")
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
    """Group consecutive segments that may be joined without a stop."""
    runs = [[segments[0]]]
    for previous, segment in pairwise(segments):
        if previous.cruise and segment.cruise and _joins(previous, segment):
            runs[-1].append(segment)
        else:
            runs.append([segment])
    return runs


def _joins(first: Segment, second: Segment) -> bool:
    """Return True if forward and yaw motion keep the same proportion from `first` to `second`."""
    # Only rounding of omega / v is tolerated: the yaw rate may then jump by no more than that.
    return all(
        math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-12) for a, b in zip(first.direction, second.direction, strict=True)
    )


def timed_run(run: Sequence[Segment], limits: TrajectoryLimits) -> list[PathStretch]:
    """Time one run from rest to rest."""
    if not run[0].cruise:
        return [PathStretch(0.0, 0.0, 0.0, [Phase(0.0, 0.0, 0.0, segment.duration)]) for segment in run]
    lengths = [segment.cruise * segment.duration for segment in run]
    phases = rest_to_rest(lengths, [segment.cruise for segment in run], _acceleration(run, limits))
    return [
        PathStretch(*segment.direction, length, timing)
        for segment, length, timing in zip(run, lengths, phases, strict=True)
    ]


def slowed(segments: Sequence[Segment], limits: TrajectoryLimits) -> list[Segment]:
    """Return segments whose speeds beyond the smaller side of a limit are reduced, with room for tracking."""
    timed = []
    for segment in segments:
        pairs = ((segment.v, limits.v), (segment.omega, limits.omega))
        excess = max((abs(value) / side_of(limit, value) for value, limit in pairs))
        if excess > 1.0:
            slower = excess / load_settings().reach_share
            changed = {"v": segment.v / slower, "omega": segment.omega / slower, "duration": segment.duration * slower}
            timed.append(segment.model_copy(update=changed))
        else:
            timed.append(segment)
    return timed


def _acceleration(run: Sequence[Segment], limits: TrajectoryLimits) -> float:
    """Compute the maximum change of the progress rate for which each moving segment of `run` has room."""
    bounds = (limits.v_acceleration, limits.omega_acceleration)
    return min(
        bound / abs(share) for segment in run for share, bound in zip(segment.direction, bounds, strict=True) if share
    )
