"""Conversion of pieces to phases in time: pieces of free duration, and ramps of fixed duration between speeds."""

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
_MIN_PIECE = 0.05
_SAME_SPEED = 1e-6
# Maximum ratio of the ramps to the length of a run; reaching a speed and stopping needs a length of v^2 / a.
_RAMP_RATIO = 0.8


@dataclass(frozen=True, eq=False)
class Schedule:
    """Nodes of the command, which is linear in time between the nodes.

    Attributes
    ----------
    speeds
        (n + 1,) commanded speed at the nodes [m/s].
    yaw_rates
        (n + 1,) commanded yaw rate of the search at the nodes [rad/s].
    max_yaw_rate
        (n + 1,) maximum yaw rate at the nodes [rad/s].
    phase
        (n,) index of the phase of each interval.
    durations
        (phases,) durations of the search [s].
    free
        (phases,) True for pieces, whose duration is free; False for ramps.
    legs
        (n,) leg of each interval.
    poses
        (n + 1, 3) poses at the nodes, along the path of the search.
    """

    speeds: FloatArray
    yaw_rates: FloatArray
    max_yaw_rate: FloatArray
    phase: NDArray[np.intp]
    durations: FloatArray
    free: NDArray[np.bool_]
    legs: NDArray[np.intp]
    poses: FloatArray

    @property
    def counts(self) -> NDArray[np.intp]:
        """(phases,) number of intervals of each phase."""
        return np.bincount(self.phase, minlength=len(self.durations))

    def steps(self, durations: FloatArray) -> FloatArray:
        """Return the duration (n,) of each interval [s]."""
        return np.asarray((durations / self.counts)[self.phase])


def build_schedule(
    costs: TurnCosts,
    start: FloatArray,
    pieces: Sequence[Piece],
    sharpest: float,
    spot: float,
    settings: PlanSettings,
    *,
    stop_at_corners: bool = False,
) -> Schedule:
    """Build the schedule of the pieces, at rest at both ends.

    Parameters
    ----------
    costs, start
        Slip law, and pose (3,) at the start.
    pieces
        Pieces of the search.
    sharpest
        Minimum commanded radius [m].
    spot
        Maximum commanded yaw rate on the spot [rad/s].
    settings
        Acceleration, yaw rate, and resolution.
    stop_at_corners
        True to stop between pieces, so that the curvature of each piece is constant as in the search.
    """
    long_pieces = [piece for piece in pieces if piece.duration > _MIN_PIECE] or list(pieces)
    long_pieces = limit_speeds(long_pieces, settings.motion.acceleration, each=stop_at_corners)
    builder = _ScheduleBuilder(costs, start, long_pieces, sharpest, spot, settings)
    for i, piece in enumerate(long_pieces):
        builder.ramp(piece.v, i)
        after = 0.0 if i == len(long_pieces) - 1 or stop_at_corners else long_pieces[i + 1].v
        builder.hold(i, after, from_rest=i == 0 or stop_at_corners)
        if stop_at_corners:
            builder.ramp(0.0, i)
    builder.ramp(0.0, len(long_pieces) - 1)
    return builder.schedule()


def limit_speeds(pieces: Sequence[Piece], acceleration: float, *, each: bool = False) -> list[Piece]:
    """Lower the speed of pieces that are too short to reach it and stop; `each` stops after each piece."""
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
        max_speed = math.sqrt(_RAMP_RATIO * acceleration * length)
        for part in run:
            factor = min(1.0, max_speed / abs(part.v)) if abs(part.v) > _SAME_SPEED else 1.0
            phases.append(part._replace(v=part.v * factor, omega=part.omega * factor, duration=part.duration / factor))
    return phases


class _ScheduleBuilder:
    """Builder of a schedule, node by node."""

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
        self._settings, self._motion = settings.polish, settings.motion
        total = sum(piece.duration for piece in pieces)
        self._interval = max(self._settings.interval, total / self._settings.most_nodes)
        self._speeds, self._rates, self._max_rates = [0.0], [0.0], [0.0]
        # Poses at the nodes
        self._poses = [start]
        self._phase: list[int] = []
        self._legs: list[int] = []
        self._durations: list[float] = []
        self._free: list[bool] = []
        self._curvature = 0.0

    def ramp(self, after: float, piece: int) -> None:
        """Add a ramp to another speed, with a stop if the direction changes."""
        before, current = self._speeds[-1], self._pieces[piece]
        if abs(after - before) < _SAME_SPEED:
            return
        if before * after < 0:
            self.ramp(0.0, piece)
            self.ramp(after, piece)
            return
        count, duration_of_phase = self._settings.ramp_intervals, abs(after - before) / self._motion.acceleration
        curvature = 0.0 if abs(current.v) < _SAME_SPEED else current.omega / current.v
        for k in range(1, count + 1):
            v = before + (after - before) * k / count
            self._add_node(v, v * curvature, self._max_yaw_rate_at(v), current.leg, duration_of_phase / count)
        self._end_phase(duration_of_phase, free=False)

    def hold(self, piece: int, after: float, *, from_rest: bool) -> None:
        """Add the part of a piece that is not covered by ramps."""
        current = self._pieces[piece]
        on_spot = abs(current.v) < _SAME_SPEED
        if on_spot:
            # The yaw rate ramps up from zero and down to zero.
            duration_of_phase = current.duration + abs(current.omega) / self._motion.yaw_acceleration
        else:
            change = (abs(current.v) if from_rest else 0.0) + max(0.0, abs(current.v) - abs(after))
            duration_of_phase = max(
                current.duration - 0.5 * change / self._motion.acceleration, 0.2 * min(current.duration, 1.0)
            )
        count = max(4 if on_spot else 2, math.ceil(duration_of_phase / self._interval))
        for k in range(1, count + 1):
            ends = on_spot and k == count
            max_rate = self._spot if on_spot else self._max_yaw_rate_at(current.v)
            self._add_node(
                current.v,
                0.0 if ends else current.omega,
                0.0 if ends else max_rate,
                current.leg,
                duration_of_phase / count,
            )
        self._end_phase(duration_of_phase, free=True)

    def schedule(self) -> Schedule:
        """Return the schedule."""
        return Schedule(
            speeds=np.array(self._speeds),
            yaw_rates=np.array(self._rates),
            max_yaw_rate=np.array(self._max_rates),
            phase=np.array(self._phase),
            durations=np.array(self._durations),
            free=np.array(self._free),
            legs=np.array(self._legs),
            poses=np.array(self._poses),
        )

    def _max_yaw_rate_at(self, v: float) -> float:
        return min(self._motion.yaw_rate, abs(v) / self._sharpest)

    def _add_node(self, v: float, omega: float, max_rate: float, leg: int, step: float) -> None:
        mean = np.array([0.5 * (self._speeds[-1] + v), omega if abs(v) < _SAME_SPEED else 0.0])
        if abs(v) > _SAME_SPEED or abs(self._speeds[-1]) > _SAME_SPEED:
            # Keep the curvature of the piece on the ramp.
            mean[1] = mean[0] * (omega / v if abs(v) > _SAME_SPEED else self._curvature)
        self._curvature = omega / v if abs(v) > _SAME_SPEED else 0.0
        ahead, left, turn = (self._costs.twist(mean) * step).tolist()
        x, y, theta = self._poses[-1].tolist()
        c, s = math.cos(theta + 0.5 * turn), math.sin(theta + 0.5 * turn)
        self._poses.append(np.array([x + c * ahead - s * left, y + s * ahead + c * left, theta + turn]))
        self._speeds.append(v)
        self._rates.append(omega)
        self._max_rates.append(max_rate)
        self._phase.append(len(self._durations))
        self._legs.append(leg)

    def _end_phase(self, duration_of_phase: float, *, free: bool) -> None:
        self._durations.append(duration_of_phase)
        self._free.append(free)
