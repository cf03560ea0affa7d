"""How fast the wheels get, where they stay behind what reference and commands ask of them."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.checks import TwistGate
from oracle.commands import PastCommands

# As in mpc/config/sensor_test.yaml.
_SHORT, _LEAST, _FOR, _HELD, _REGAIN, _SMOOTHED, _STEADY = 0.08, 0.04, 0.2, 0.3, 0.05, 0.2, 0.2
# So much more has to be asked, and less than so much of it gained.
_MORE, _GAINED = 0.01, 0.3
# Where the robot keeps up with its reference nothing is learned.
ASTRAY, BESIDE = 0.4, 0.4


class WheelReach:
    """Learns it tick by tick: `at_rim` is that of the wheels, `speed` the same without slip [m/s]."""

    def __init__(self, config: ControllerConfig, gain: FloatArray, lag: int) -> None:
        self.dt, self.gain = config.sample_time, gain
        self.half_track, self.most = config.wheels.track / 2, config.limits.wheel_speed
        self.wheel_yaw_ratio = config.wheels.track / config.wheels.encoder_track / gain[1, 1]
        self.window = lag + int(_FOR / self.dt) + 1
        self.restart()

    def restart(self) -> None:
        """Know of no end."""
        self.actual, self.found, self.tried, self.speed_then = np.zeros(2), 0, math.inf, 0.0
        self._know_nothing()

    def _know_nothing(self) -> None:
        self.speed = self.at_rim = math.inf

    def _rims(self, twist: FloatArray, slip: Slip) -> FloatArray:
        """Right and left wheel speeds (2, ...) for twists (2, ...) of the body."""
        v, omega = twist
        forward = (v - slip.turn_left * omega) / slip.longitudinal_gain
        turning = self.half_track * omega / (slip.omega_gain * slip.yaw_gain)
        return np.array([forward + turning, forward - turning])

    def look(self, wheels: TwistGate, t: float, wanted: FloatArray | None, slip: Slip, commands: PastCommands) -> None:
        """Compare encoders with the twist `wanted` (2,) at the tick `t` [s], None where the robot was not tracking."""
        read = self._rims(wheels.last / [1.0, self.wheel_yaw_ratio], Slip())
        self.actual = self.actual + _SMOOTHED * (read - self.actual)
        sent, found = commands.everything, None
        if wanted is not None and len(sent) >= self.window and t - wheels.stamp < _FOR:
            by_reference = self._rims(wanted, slip)
            sign = np.where(by_reference < 0, -1.0, 1.0)
            # Wheels turn as the model says: the body slips, not they.
            by_command = self._rims(self.gain @ sent[-self.window :].T, Slip()) * sign[:, None]
            asked, along = np.minimum(by_command.min(axis=1), sign * by_reference), sign * self.actual
            lacks = asked - along
            steady = np.abs(read - self.actual) < _STEADY * asked
            short = steady & (along > _HELD * asked) & (lacks > np.maximum(_SHORT * asked, _LEAST))
            if short.any() and (along <= by_command.max(axis=1) + _LEAST).all():
                found = int(np.argmax(np.where(short, lacks, -np.inf)))
        if found is not None and self._gains_nothing(found, float(by_command.min(axis=1)[found])):
            self.at_rim = abs(self.actual[found])
            needed = abs(wanted[0]) + self.half_track * abs(wanted[1])
            self.speed = abs(self.actual[found] / by_reference[found]) * needed
        else:
            self.speed, self.at_rim = (value * (1 + _REGAIN * self.dt) for value in (self.speed, self.at_rim))
        faster = abs(self.actual[self.found]) > self.at_rim * (1 + _SHORT) + _LEAST
        if faster or not self.at_rim < self.most:
            self._know_nothing()

    def _gains_nothing(self, found: int, asked: float) -> bool:
        """Whether the wheel got no faster though more was asked of it than when it was first short."""
        speed = abs(self.actual[found])
        more, gained = asked - self.tried, speed - self.speed_then
        enough = more > _MORE * asked
        if found != self.found or more < 0 or (enough and gained > _GAINED * more):
            self.found, self.tried, self.speed_then = found, asked, speed
            return False
        return enough
