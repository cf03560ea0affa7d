"""Excitation drive that separates the slip terms, inside a square, for `diffdrive-mpc excite --for slip`."""

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

WRITTEN_BY = "# Written by `diffdrive-mpc excite"
"""Start of the files of `excite`; it replaces no other file."""
SPEEDS = (1 / 3, 2 / 3, 1.0)
"""Fractions of the maximum speed; Ordonez et al., 2017 drive at 0.2, 0.4 and 0.6 m/s."""
YAW_RATES = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
"""Fractions of the maximum yaw rate; Ordonez et al. alternate left and right, from straight to a radius of 0.56 m."""

_REVERSAL_FACTOR = 1.1
"""Factor by which the gain of a reversal must exceed that of other twists, because a reversal takes time."""


def slip_excitation(
    side: float, seconds: float, speed: float, yaw_rate: float, hold: float = 2.5, margin: float = 0.3
) -> list[Segment]:
    """Design piecewise-constant twists with the most information about the nine slip coefficients, inside a square.

    Each row of the slip law has the terms v, w and v w (see `models.slip_laws.polynomial_twist`). The information of a
    drive is the matrix M of the products of these terms, integrated over time. Each step appends the twist that
    increases det M most (a greedy D-optimal design), among the twists that stay inside and that another twist can
    follow. The robot starts in the middle of the square.

    Parameters
    ----------
    side
        Side length of the square [m].
    seconds
        Approximate duration of the drive [s].
    speed, yaw_rate
        Maximum speed [m/s] and yaw rate [rad/s].
    hold
        Duration of each twist [s].
    margin
        Minimum distance of the robot's centre from the edges of the square [m].

    Raises
    ------
    ValueError
        If an argument is not positive, the duration is too long, or the square is too small to turn in.
    """
    for name, value in (("--side", side), ("--seconds", seconds), ("--speed", speed), ("--yaw-rate", yaw_rate)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} {value}: give a positive number")
    longest = load_settings().max_excitation_duration
    if seconds > longest:
        raise ValueError(f"time {seconds:g} s: give at most {longest:g} s; drive it several times for more")
    # Reverse motion determines the same terms and lets the robot stay in small squares.
    twists = [
        np.array([sign * share * speed, turn * yaw_rate])
        for sign, share, turn in itertools.product((1, -1), SPEEDS, YAW_RATES)
    ]
    reach, pose = 0.5 * side - margin, np.array([0.0, 0.0, math.pi / 4])
    if reach < 0.5 * speed * hold:
        raise ValueError(
            f"side {side} m: too small for {speed} m/s over {hold} s at {margin} m from the edges; give "
            f"{2 * (margin + 0.5 * speed * hold):.1f} m or more, or a lower speed"
        )
    information, selected_segments = 1e-3 * np.eye(3), list[Segment]()
    scale = np.array([speed, yaw_rate, speed * yaw_rate])
    for _ in range(max(1, round(seconds / hold))):
        best, max_gain = None, -math.inf
        for twist in twists:
            end = _end(pose, twist, hold, reach)
            if end is None or not any(_end(end, following, hold, reach) is not None for following in twists):
                continue
            z = np.array([twist[0], twist[1], twist[0] * twist[1]]) / scale
            gain = 1 + hold * float(z @ np.linalg.solve(information, z))
            if selected_segments and np.sign(twist[0]) != np.sign(selected_segments[-1].v):
                gain /= _REVERSAL_FACTOR
            if gain > max_gain:
                best, max_gain = (twist, end, z), gain
        if best is None:
            raise ValueError(
                f"side {side} m: no twist stays inside at {pose[0]:.1f}, {pose[1]:.1f} m; use a longer side"
            )
        twist, pose, z = best
        information = information + hold * np.outer(z, z)
        selected_segments.append(Segment(v=float(twist[0]), omega=float(twist[1]), duration=hold))
    return selected_segments


def max_term_correlation(segments: Sequence[Segment]) -> float:
    """Compute the maximum absolute correlation of the terms v, omega and v omega over a drive.

    A correlation of 1 means that the terms cannot be separated.
    """
    terms = np.array([[segment.v, segment.omega, segment.v * segment.omega] for segment in segments])
    weights = np.array([segment.duration for segment in segments])
    products = (terms * weights[:, None]).T @ terms
    size = np.sqrt(np.maximum(np.diag(products), 1e-12))
    return float(np.abs(products / np.outer(size, size) - np.eye(3)).max())


def write_slip_drive(path: str | Path, segments: Sequence[Segment]) -> str:
    """Write a trajectory file that `load_trajectory` reads, and return its description.

    Raises ConfigError if the file cannot be written.
    """
    drive = {
        "name": "slip excitation",
        "start": [0.0, 0.0, math.pi / 4],
        "timing": "smooth",
        "segments": [{key: round(value, 4) for key, value in segment.model_dump().items()} for segment in segments],
    }
    text = yaml.safe_dump(drive, sort_keys=False, default_flow_style=None)
    with whole_file(path, begins=WRITTEN_BY.encode()) as draft:
        draft.write_text(f"{WRITTEN_BY} --for slip`.\n{text}", encoding="utf-8")
    return (
        f"{path}: {len(segments)} twists, {sum(segment.duration for segment in segments):.0f} s without transitions. "
        f"Maximum correlation of the terms v, omega and v omega: {max_term_correlation(segments):.2f} "
        "(1: not separable)."
    )


def _end(pose: FloatArray, twist: FloatArray, hold: float, reach: float) -> FloatArray | None:
    """Compute the pose at the end of `twist`; None if the path leaves the square."""
    path = integrate_pose(pose, twist[0], twist[1], np.linspace(0.0, hold, 11)[1:])
    return path[-1] if np.abs(path[:, :2]).max() <= reach else None
