"""Regulated pure pursuit of a timed reference.

Source: S. Macenski, S. Singh, F. Martin, J. Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots
2023, as implemented in Nav2: the robot drives on the arc through the point at a look-ahead distance, which is
proportional to the speed within bounds; it slows down on tight arcs and rotates to the heading of a reference at rest.
The original law tracks a path without times. Here the speed is that of the reference plus feedback of the error along
the path.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers.tracking_peer import REST_SPEED, AboveZero, Gains, LawInput, NotNegative, RobotParameters
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

_MAX_LOOK_AHEAD = 1.0
"""Maximum look-ahead distance [m]."""
_SAMPLE_TIMES = np.arange(0.0, 2.0, 0.05)
"""Times after the current time at which the path is sampled [s], long enough for a slow start."""


class PursuitGains(Gains):
    """Gains of the law."""

    look_ahead_time: AboveZero = Field(description="ratio of look-ahead distance to speed [s]")
    min_look_ahead: AboveZero = Field(description="minimum look-ahead distance [m]")
    along: NotNegative = Field(description="gain of the error along the path [1/s]")
    turn: NotNegative = Field(description="gain of the heading error during a turn on the spot [1/s]")
    least_radius: NotNegative = Field(description="radius below which the speed is proportional to the radius [m]")


class PursuitLaw:
    """Pure pursuit: follow the arc through a point on the path ahead, at the speed of the reference."""

    gains = PursuitGains

    def __init__(self, gains: PursuitGains, robot: RobotParameters) -> None:
        del robot  # the law does not depend on parameters of the robot
        self._gains = gains

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        self._reference = reference

    def decide(self, law_input: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        gains, (v, omega) = self._gains, law_input.feed_forward
        ahead, _, heading = law_input.error
        if abs(v) <= REST_SPEED:
            return np.array([gains.along * ahead, omega + gains.turn * heading])
        x, y = self.look_ahead_point(law_input)
        curvature = 2 * y / (x * x + y * y)
        demanded_speed = v + gains.along * ahead
        # The factor is positive, so the direction of travel does not change.
        speed = demanded_speed * min(1.0, 1.0 / max(abs(curvature) * gains.least_radius, 1e-9))
        return np.array([speed, speed * curvature])

    def look_ahead_point(self, law_input: LawInput) -> FloatArray:
        """Compute the look-ahead point (2,) in the robot's frame [m]; the path is extended straight at reversals."""
        gains, v = self._gains, law_input.feed_forward[0]
        direction = np.sign(v)
        distance = float(np.clip(gains.look_ahead_time * abs(v), gains.min_look_ahead, _MAX_LOOK_AHEAD))
        path = self._reference.sample(law_input.time + _SAMPLE_TIMES)
        is_moving = direction * path.twist[:, 0] > REST_SPEED
        start = int(np.argmax(is_moving))
        stops = np.flatnonzero(~is_moving[start:])
        last = (start + int(stops[0]) if stops.size else len(_SAMPLE_TIMES) - 1) if is_moving.any() else 0
        distances = path.arc_length[: last + 1] - path.arc_length[0]
        point = np.array([np.interp(distance, distances, path.pose[: last + 1, i]) for i in (0, 1)])
        extension = direction * max(0.0, distance - distances[-1])
        heading = path.pose[last, 2]
        offset = point + extension * np.array([np.cos(heading), np.sin(heading)]) - law_input.motion.pose[:2]
        return np.array(ahead_and_left(offset, law_input.motion.pose[2]))
