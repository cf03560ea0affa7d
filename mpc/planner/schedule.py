"""Pieces as phases in time: pieces of free duration and, between speeds, ramps of fixed duration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.planner.search import Piece
from diffdrive_mpc.mpc.planner.settings import PlanSettings

# Shorter pieces are dropped [s].
_SHORTEST = 0.05
_SAME_SPEED = 1e-6


@dataclass(frozen=True, eq=False)
class Schedule:
    """Nodes at which the command stands, straight in time between them.

    Attributes
    ----------
    speeds
        (n + 1,) commanded v at the nodes [m/s].
    yaw_rates
        (n + 1,) commanded omega at the nodes by the search [rad/s].
    most
        (n + 1,) largest |omega| there [rad/s].
    phase
        (n,) number of the phase of each interval.
    durations
        (phases,) [s] by the search.
    free
        (phases,) of bool: pieces, whose duration is free; ramps are not.
    legs
        (n,) leg of each interval.
    """

    speeds: FloatArray
    yaw_rates: FloatArray
    most: FloatArray
    phase: NDArray[np.intp]
    durations: FloatArray
    free: NDArray[np.bool_]
    legs: NDArray[np.intp]

    @property
    def counts(self) -> FloatArray:
        """(phases,) intervals of each phase."""
        return np.bincount(self.phase, minlength=len(self.durations))

    def steps(self, durations: FloatArray) -> FloatArray:
        """(n,) duration of each interval [s]."""
        return np.asarray((durations / self.counts)[self.phase])


def laid_out(
    pieces: Sequence[Piece], sharpest: float, spot: float, settings: PlanSettings, *, stop_at_corners: bool = False
) -> Schedule:
    """Phases of the pieces, at rest at both ends.

    Parameters
    ----------
    pieces
        Of the search.
    sharpest
        Least commanded radius [m].
    spot
        Fastest commanded yaw rate on the spot [rad/s].
    settings
        Acceleration, yaw rate, and how finely.
    stop_at_corners
        Whether it comes to rest between any two pieces, so that each is driven as the search has it; then the yaw rate
        is that of the piece's curvature all along.
    """
    asked, motion = settings.polish, settings.motion
    kept = [one for one in pieces if one.duration > _SHORTEST] or list(pieces)
    total = sum(one.duration for one in kept)
    interval = max(asked.interval, total / asked.most_nodes)
    speeds, rates, most = [0.0], [0.0], [0.0]
    phase: list[int] = []
    legs: list[int] = []
    durations: list[float] = []
    free: list[bool] = []

    def limit(v: float) -> float:
        return min(motion.yaw_rate, abs(v) / sharpest)

    def ramp(after: float, leg: int, curvature: float) -> None:
        before = speeds[-1]
        if abs(after - before) < _SAME_SPEED:
            return
        if before * after < 0:
            ramp(0.0, leg, curvature)
            ramp(after, leg, curvature)
            return
        count = asked.ramp_intervals
        for k in range(1, count + 1):
            v = before + (after - before) * k / count
            speeds.append(v)
            most.append(limit(v))
            rates.append(v * curvature)
            phase.append(len(durations))
            legs.append(leg)
        durations.append(abs(after - before) / motion.acceleration)
        free.append(False)

    for i, piece in enumerate(kept):
        on_spot = abs(piece.v) < _SAME_SPEED
        curvature = 0.0 if on_spot else piece.omega / piece.v
        ramp(piece.v, piece.leg, curvature)
        after = 0.0 if i == len(kept) - 1 or stop_at_corners else kept[i + 1].v
        # Ramps cover half of what they last.
        covered = 0.0
        if not on_spot:
            first = i == 0 or stop_at_corners
            change = (abs(piece.v) if first else 0.0) + max(0.0, abs(piece.v) - abs(after))
            covered = 0.5 * change / motion.acceleration
        lasting = max(piece.duration - covered, 0.2 * min(piece.duration, 1.0))
        if on_spot:
            # The yaw rate rises from zero and falls to it again.
            lasting = piece.duration + abs(piece.omega) / motion.yaw_acceleration
        count = max(4 if on_spot else 2, math.ceil(lasting / interval))
        for k in range(1, count + 1):
            speeds.append(piece.v)
            most.append((0.0 if k == count else spot) if on_spot else limit(piece.v))
            rates.append(0.0 if on_spot and k == count else piece.omega)
            phase.append(len(durations))
            legs.append(piece.leg)
        durations.append(lasting)
        free.append(True)
        if stop_at_corners:
            ramp(0.0, piece.leg, curvature)
    ramp(0.0, kept[-1].leg, 0.0 if abs(kept[-1].v) < _SAME_SPEED else kept[-1].omega / kept[-1].v)
    return Schedule(
        np.array(speeds),
        np.array(rates),
        np.array(most),
        np.array(phase),
        np.array(durations),
        np.array(free),
        np.array(legs),
    )
