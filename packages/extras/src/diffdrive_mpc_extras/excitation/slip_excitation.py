"""A drive that separates the slip terms, inside a square: for `diffdrive-mpc excite --for slip`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.segments import Segment

SPEEDS = (1 / 3, 2 / 3, 1.0)
"""Shares of the largest speed; Ordonez et al., 2017 drive at 0.2, 0.4 and 0.6 m/s."""
YAW_RATES = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of the largest yaw rate; theirs go left and right in turn, from straight ahead to a radius of 0.56 m."""

# A reversal costs time and contains no information: its value must exceed the alternative by this factor.
_REVERSAL = 1.1


def slip_excitation(
    side: float, seconds: float, speed: float, yaw_rate: float, hold: float = 2.5, margin: float = 0.3
) -> list[Segment]:
    """Design twists, each held, that identify nine slip terms best, for a robot in the middle of a square.

    All three rows of slip have the terms v, w and v w (see `models.slip_laws.polynomial_twist`), so the information of
    a drive about them is the matrix M of their products, summed over time. The next twist is the one that lets det M
    grow most (a greedy D-optimal design), among those that stay inside and from whose end one can go on.

    Parameters
    ----------
    side
        Side length of the square [m].
    seconds
        Approximate duration of the drive [s].
    speed, yaw_rate
        Largest ones [m/s, rad/s].
    hold
        Duration of each twist [s].
    margin
        Least distance of the robot's centre from the square's edge [m].

    Raises
    ------
    ValueError
        If a number is not positive, or the square too small to turn round in.
    """
    for name, value in (("side", side), ("time", seconds), ("speed", speed), ("yaw rate", yaw_rate)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} {value}: give a positive number")
    longest = load_settings().longest_excitation
    if seconds > longest:
        raise ValueError(f"time {seconds:g} s: give at most {longest:g} s; drive it several times for more")
    # Both directions of travel: a robot that reverses stays in small squares, and determines the same terms.
    twists = [
        np.array([sign * share * speed, turn * yaw_rate])
        for sign, share, turn in itertools.product((1, -1), SPEEDS, YAW_RATES)
    ]
    reach, pose = 0.5 * side - margin, np.array([0.0, 0.0, math.pi / 4])
    if reach < 0.5 * speed * hold:
        raise ValueError(
            f"side {side} m: at {speed} m/s for {hold} s a robot that stays {margin} m inside cannot drive there; give "
            f"{2 * (margin + 0.5 * speed * hold):.1f} m or more, or a lower speed"
        )
    information, chosen = 1e-3 * np.eye(3), list[Segment]()
    scale = np.array([speed, yaw_rate, speed * yaw_rate])
    for _ in range(max(1, round(seconds / hold))):
        best, most = None, -math.inf
        for twist in twists:
            end = _end(pose, twist, hold, reach)
            if end is None or not any(_end(end, following, hold, reach) is not None for following in twists):
                continue
            z = np.array([twist[0], twist[1], twist[0] * twist[1]]) / scale
            gain = 1 + hold * float(z @ np.linalg.solve(information, z))
            if chosen and np.sign(twist[0]) != np.sign(chosen[-1].v):
                gain /= _REVERSAL
            if gain > most:
                best, most = (twist, end, z), gain
        if best is None:
            raise ValueError(f"side {side} m: no way on at {pose[0]:.1f}, {pose[1]:.1f} m; give a larger one")
        twist, pose, z = best
        information = information + hold * np.outer(z, z)
        chosen.append(Segment(v=float(twist[0]), omega=float(twist[1]), duration=hold))
    return chosen


def told_apart(segments: Sequence[Segment]) -> float:
    """Compute the maximum absolute correlation of the terms v, omega and v omega over a drive: 1 hides one."""
    terms = np.array([[segment.v, segment.omega, segment.v * segment.omega] for segment in segments])
    weights = np.array([segment.duration for segment in segments])
    products = (terms * weights[:, None]).T @ terms
    size = np.sqrt(np.maximum(np.diag(products), 1e-12))
    return float(np.abs(products / np.outer(size, size) - np.eye(3)).max())


def write_slip_drive(path: str | Path, segments: Sequence[Segment]) -> str:
    """Write a trajectory file that `load_trajectory` reads, and return a sentence about it.

    Raises ConfigError if the file cannot be written.
    """
    drive = {
        "name": "slip excitation",
        "start": [0.0, 0.0, math.pi / 4],
        "timing": "smooth",
        "segments": [{key: round(value, 4) for key, value in segment.model_dump().items()} for segment in segments],
    }
    with whole_file(path) as draft:
        draft.write_text(yaml.safe_dump(drive, sort_keys=False, default_flow_style=None), encoding="utf-8")
    return (
        f"{path}: {len(segments)} twists, {sum(segment.duration for segment in segments):.0f} s without the time to "
        "change between them. Terms in v, omega and v omega: the two least apart correlate by "
        f"{told_apart(segments):.2f} (1: not apart)."
    )


def _end(pose: FloatArray, twist: FloatArray, hold: float, reach: float) -> FloatArray | None:
    """Compute the end of `twist`; None if it is outside the square."""
    way = integrate_pose(pose, twist[0], twist[1], np.linspace(0.0, hold, 11)[1:])
    return way[-1] if np.abs(way[:, :2]).max() <= reach else None
