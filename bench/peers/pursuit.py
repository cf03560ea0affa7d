"""Regulated pure pursuit of a timed reference.

Source: S. Macenski, S. Singh, F. Martin, J. Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots
2023, as implemented in Nav2: a look-ahead distance that grows with speed between bounds, the arc through that point,
reduced speed on tight arcs, and turning to the heading of a standing reference. The original tracks a path; a reference
also has times, so the speed is that of the reference plus feedback of the lag along it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers.tracking_peer import STANDING, AboveZero, Delayed, Gains, LawInput, NotNegative
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

_MAX_LOOK_AHEAD = 1.0
"""Bound of the look-ahead distance [m]."""
_AHEAD = np.arange(0.0, 2.0, 0.05)
"""Times from now at which the path ahead is sampled [s]; the slowest start covers the minimum look-ahead in them."""


class PursuitGains(Gains):
    """Tuned gains."""

    look_ahead_time: AboveZero = Field(description="look-ahead distance over speed [s]")
    min_look_ahead: AboveZero = Field(description="lower bound of the look-ahead distance [m]")
    along: NotNegative = Field(description="gain of the lag along the path [1/s]")
    turn: NotNegative = Field(description="gain of the heading error while turning on the spot [1/s]")
    least_radius: NotNegative = Field(description="radius below which the speed decreases with the radius [m]")


class PursuitLaw:
    """Law that follows the arc through a point on the path ahead, at the speed of the reference."""

    gains = PursuitGains

    def __init__(self, gains: PursuitGains, robot: Delayed) -> None:
        del robot  # the law needs no data of the robot besides the prediction
        self._gains = gains

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        self._reference = reference

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        gains, (v, omega) = self._gains, sight.feed_forward
        ahead, _, heading = sight.error
        if abs(v) <= STANDING:
            return np.array([gains.along * ahead, omega + gains.turn * heading])
        x, y = self.carrot(sight)
        curvature = 2 * y / (x * x + y * y)
        pace = v + gains.along * ahead
        # Reduce the speed on a tight arc; the direction of travel stays.
        regulated = pace * min(1.0, 1.0 / max(abs(curvature) * gains.least_radius, 1e-9))
        return np.array([regulated, regulated * curvature])

    def carrot(self, sight: LawInput) -> FloatArray:
        """Compute the target point (2,) in the robot's frame [m]; a path that ends or reverses is extended straight."""
        gains, v = self._gains, sight.feed_forward[0]
        direction = np.sign(v)
        distance = float(np.clip(gains.look_ahead_time * abs(v), gains.min_look_ahead, _MAX_LOOK_AHEAD))
        path = self._reference.sample(sight.time + _AHEAD)
        moves = direction * path.twist[:, 0] > STANDING
        start = int(np.argmax(moves))
        rest = np.flatnonzero(~moves[start:])
        last = start + int(rest[0]) if moves.any() and rest.size else len(_AHEAD) - 1 if moves.any() else 0
        covered = path.arc_length[: last + 1] - path.arc_length[0]
        point = np.array([np.interp(distance, covered, path.pose[: last + 1, i]) for i in (0, 1)])
        beyond = direction * max(0.0, distance - covered[-1])
        heading = path.pose[last, 2]
        gap = point + beyond * np.array([np.cos(heading), np.sin(heading)]) - sight.motion.pose[:2]
        return np.array(ahead_and_left(gap, sight.motion.pose[2]))
