"""Nonlinear tracking law of Kanayama et al.

Source: Y. Kanayama, Y. Kimura, F. Miyazaki, T. Noguchi, "A stable tracking control method for an autonomous mobile
robot", ICRA 1990.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.peers.tracking_peer import AboveZero, Gains, LawInput, NotNegative, RobotParameters
from diffdrive_mpc.models.interface import FloatArray, Reference


class KanayamaGains(Gains):
    """Gains of the law."""

    along: AboveZero = Field(description="gain of the error along the path [1/s]")
    across: AboveZero = Field(description="gain of the error across the path [1/m^2]")
    heading: AboveZero = Field(description="gain of the sine of the heading error, per travelled distance [1/m]")
    turn: NotNegative = Field(
        0.0, description="gain of the sine of the heading error at rest, which is not in the paper [1/s]"
    )


def kanayama_twist(gains: KanayamaGains, feed_forward: FloatArray, error: FloatArray) -> FloatArray:
    """Compute v [m/s] and omega [rad/s] (2,): feed-forward (2,) plus feedback of `LawInput.error` (3,).

    The heading term contains |v|, so that the law is also stable while the robot reverses.
    """
    v, omega = feed_forward
    ahead, left, heading = error
    heading_gain = abs(v) * gains.heading + gains.turn
    return np.array(
        [v * np.cos(heading) + gains.along * ahead, omega + v * gains.across * left + heading_gain * np.sin(heading)]
    )


class KanayamaLaw:
    """Kanayama's law, applied to the predicted motion."""

    gains = KanayamaGains

    def __init__(self, gains: KanayamaGains, robot: RobotParameters) -> None:
        del robot  # the law does not depend on parameters of the robot
        self._gains = gains

    def start(self, reference: Reference) -> None:
        """Start to track `reference`; the law needs no preparation."""

    def decide(self, law_input: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        return kanayama_twist(self._gains, law_input.feed_forward, law_input.error)
