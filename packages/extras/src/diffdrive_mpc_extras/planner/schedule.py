"""Pieces as phases in time: pieces of free duration and, between speeds, ramps of fixed duration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.planner.search import Piece
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts

# Shorter pieces are dropped [s].
_SHORTEST = 0.05
_SAME_SPEED = 1e-6
# v^2 / a of length is needed to reach a speed and stop again.
_SHARE_OF_RAMPS = 0.8


@dataclass(frozen=True, eq=False)
class Schedule:
    """Nodes of the command, which is linear in time between them.

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
    poses
        (n + 1, 3) poses at the nodes, along the way of the search.
    """

    speeds: FloatArray
    yaw_rates: FloatArray
    most: FloatArray
    phase: NDArray[np.intp]
    durations: FloatArray
    free: NDArray[np.bool_]
    legs: NDArray[np.intp]
    poses: FloatArray

    @property
    def counts(self) -> NDArray[np.intp]:
        """(phases,) intervals of each phase."""
        return np.bincount(self.phase, minlength=len(self.durations))

    def steps(self, durations: FloatArray) -> FloatArray:
        """Return the duration (n,) of each interval [s]."""
        return np.asarray((durations / self.counts)[self.phase])


def laid_out(
    costs: TurnCosts,
    start: FloatArray,
    pieces: Sequence[Piece],
    sharpest: float,
    spot: float,
    settings: PlanSettings,
    *,
    stop_at_corners: bool = False,
) -> Schedule:
    """Lay out phases of the pieces, at rest at both ends.

    Parameters
    ----------
    costs, start
        Slip law, and the pose (3,) at the start.
    pieces
        Pieces of the search.
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
    long_pieces = [piece for piece in pieces if piece.duration > _SHORTEST] or list(pieces)
    long_pieces = slowed(long_pieces, settings.motion.acceleration, each=stop_at_corners)
    laid = _Layer(costs, start, long_pieces, sharpest, spot, settings)
    for i, piece in enumerate(long_pieces):
        laid.ramp(piece.v, i)
        after = 0.0 if i == len(long_pieces) - 1 or stop_at_corners else long_pieces[i + 1].v
        laid.hold(i, after, from_rest=i == 0 or stop_at_corners)
        if stop_at_corners:
            laid.ramp(0.0, i)
    laid.ramp(0.0, len(long_pieces) - 1)
    return laid.schedule()


def slowed(pieces: Sequence[Piece], acceleration: float, *, each: bool = False) -> list[Piece]:
    """Lower the speed of pieces too short to reach it and stop again; `each` stops after each."""
    runs: list[list[Piece]] = []
    for piece in pieces:
        follows = runs and not each and abs(piece.v) > _SAME_SPEED and runs[-1][-1].v * piece.v > 0
        if follows:
            runs[-1].append(piece)
        else:
            runs.append([piece])
    phases = []
    for run in runs:
        length = sum(abs(part.v) * part.duration for part in run)
        most = math.sqrt(_SHARE_OF_RAMPS * acceleration * length)
        for part in run:
            slower = min(1.0, most / abs(part.v)) if abs(part.v) > _SAME_SPEED else 1.0
            phases.append(part._replace(v=part.v * slower, omega=part.omega * slower, duration=part.duration / slower))
    return phases


class _Layer:
    """Nodes, one after the other."""

    def __init__(
        self,
        costs: TurnCosts,
        start: FloatArray,
        pieces: Sequence[Piece],
        sharpest: float,
        spot: float,
        settings: PlanSettings,
    ) -> None:
        self._costs, self._pieces, self._sharpest, self._spot = costs, pieces, sharpest, spot
        self._asked, self._motion = settings.polish, settings.motion
        total = sum(piece.duration for piece in pieces)
        self._interval = max(self._asked.interval, total / self._asked.most_nodes)
        self._speeds, self._rates, self._most = [0.0], [0.0], [0.0]
        # Driven part of each piece at each node, and the poses.
        self._places = [start]
        self._phase: list[int] = []
        self._legs: list[int] = []
        self._durations: list[float] = []
        self._free: list[bool] = []
        self._curvature = 0.0

    def ramp(self, after: float, piece: int) -> None:
        """Change the speed, through rest where the direction changes."""
        before, current = self._speeds[-1], self._pieces[piece]
        if abs(after - before) < _SAME_SPEED:
            return
        if before * after < 0:
            self.ramp(0.0, piece)
            self.ramp(after, piece)
            return
        count, lasting = self._asked.ramp_intervals, abs(after - before) / self._motion.acceleration
        curvature = 0.0 if abs(current.v) < _SAME_SPEED else current.omega / current.v
        for k in range(1, count + 1):
            v = before + (after - before) * k / count
            self._node(v, v * curvature, self._limit(v), current.leg, lasting / count)
        self._close(lasting, free=False)

    def hold(self, piece: int, after: float, *, from_rest: bool) -> None:
        """Hold a piece, except for the part that ramps cover."""
        current = self._pieces[piece]
        on_spot = abs(current.v) < _SAME_SPEED
        if on_spot:
            # The yaw rate rises from zero and falls to it again.
            lasting = current.duration + abs(current.omega) / self._motion.yaw_acceleration
        else:
            change = (abs(current.v) if from_rest else 0.0) + max(0.0, abs(current.v) - abs(after))
            lasting = max(current.duration - 0.5 * change / self._motion.acceleration, 0.2 * min(current.duration, 1.0))
        count = max(4 if on_spot else 2, math.ceil(lasting / self._interval))
        for k in range(1, count + 1):
            ends = on_spot and k == count
            most = self._spot if on_spot else self._limit(current.v)
            self._node(current.v, 0.0 if ends else current.omega, 0.0 if ends else most, current.leg, lasting / count)
        self._close(lasting, free=True)

    def schedule(self) -> Schedule:
        """Return the result."""
        return Schedule(
            speeds=np.array(self._speeds),
            yaw_rates=np.array(self._rates),
            most=np.array(self._most),
            phase=np.array(self._phase),
            durations=np.array(self._durations),
            free=np.array(self._free),
            legs=np.array(self._legs),
            poses=np.array(self._places),
        )

    def _limit(self, v: float) -> float:
        return min(self._motion.yaw_rate, abs(v) / self._sharpest)

    def _node(self, v: float, omega: float, most: float, leg: int, step: float) -> None:
        mean = np.array([0.5 * (self._speeds[-1] + v), omega if abs(v) < _SAME_SPEED else 0.0])
        if abs(v) > _SAME_SPEED or abs(self._speeds[-1]) > _SAME_SPEED:
            # The path of the piece, at the speed of the ramp.
            mean[1] = mean[0] * (omega / v if abs(v) > _SAME_SPEED else self._curvature)
        self._curvature = omega / v if abs(v) > _SAME_SPEED else 0.0
        ahead, left, turn = (self._costs.twist(mean) * step).tolist()
        x, y, theta = self._places[-1].tolist()
        c, s = math.cos(theta + 0.5 * turn), math.sin(theta + 0.5 * turn)
        self._places.append(np.array([x + c * ahead - s * left, y + s * ahead + c * left, theta + turn]))
        self._speeds.append(v)
        self._rates.append(omega)
        self._most.append(most)
        self._phase.append(len(self._durations))
        self._legs.append(leg)

    def _close(self, lasting: float, *, free: bool) -> None:
        self._durations.append(lasting)
        self._free.append(free)
