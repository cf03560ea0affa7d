"""Attainable wheel speed, estimated while the wheels cannot follow reference and commands."""

from __future__ import annotations

import math

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.checks import TwistGate
from oracle.commands import PastCommands

# Constants of mpc/config/sensor_test.yaml.
_SHORT, _MARGIN, _SLOWER, _TIME, _SHARE, _FILTER, _STEADY = 0.08, 0.04, 0.25, 0.2, 0.3, 0.2, 0.2
_ON_SPOT, _FAR_BELOW, _SLOWED, _RETRY, _REGAIN = 0.5, 0.5, 0.75, 0.7, (0.6, 0.2)
# Minimum relative increase of the command; maximum ratio of the increases of speed and command of a saturated wheel.
_INCREASE, _GAIN = 0.03, 0.15
# Delay [s] and share of the band above which the limit is estimated.
ASTRAY, BESIDE = 0.25, 0.25


class WheelReach:
    """Limits of the wheel speed [m/s]: the estimate `attained` and the applied limit `allowed`."""

    def __init__(self, config: ControllerConfig, gain: FloatArray, lag: int) -> None:
        self.dt, self.gain, self.enabled = config.sample_time, gain, config.monitor.wheel_limits
        self.half_track, self.max_speed = config.wheels.track / 2, config.limits.wheel_speed
        self.wheel_yaw_ratio = config.wheels.track / config.wheels.encoder_track / gain[1, 1]
        self.window = lag + max(int(_TIME / self.dt), 4 * lag // 3) + 1
        self.restart()

    def restart(self) -> None:
        """Reset the estimated limit."""
        self.actual, self.short_wheel, self.tried, self.tried_speed = np.zeros(2), 0, math.inf, 0.0
        self.slowed, self.on_spot = 0.0, False
        self._clear()

    def _clear(self) -> None:
        self.allowed = self.attained = math.inf

    def _speeds(self, twist: FloatArray, slip: Slip) -> FloatArray:
        """Compute right and left wheel speeds (2, ...) for twists (2, ...) of the body."""
        v, omega = twist
        forward = (v - slip.turn_left * omega) / slip.longitudinal_gain
        turning = self.half_track * omega / (slip.omega_gain * slip.yaw_gain)
        return np.array([forward + turning, forward - turning])

    def update(
        self,
        wheels: TwistGate,
        t: float,
        next_twists: FloatArray,
        slip: Slip,
        commands: PastCommands,
        astray: bool | None,
    ) -> None:
        """Compare the encoders at tick `t` [s] with the next twists (n, 2) of the reference; the second is current.

        `astray` is True if the robot is late or off its path, None while it is not tracking.
        """
        readings = self._speeds(wheels.last / [1.0, self.wheel_yaw_ratio], Slip())
        self.actual = self.actual + _FILTER * (readings - self.actual)
        target, was_on_spot = next_twists[1], self.on_spot
        self.on_spot = bool(abs(target[0]) < _ON_SPOT * self.half_track * abs(target[1]))
        if self.on_spot != was_on_spot:
            self._clear()
            self.tried = math.inf
        required = float((np.abs(next_twists) @ [1.0, self.half_track / slip.yaw_gain]).max())
        sent_commands, wheel = commands.everything, None
        is_checked = astray or (astray is not None and math.isfinite(self.attained))
        if self.enabled and is_checked and len(sent_commands) >= self.window and t - wheels.stamp < _TIME:
            by_reference = self._speeds(target, slip)
            sign = np.where(by_reference < 0, -1.0, 1.0)[:, None]
            twists = self.gain @ sent_commands[-self.window :].T
            # During other motion a saturated wheel is indistinguishable from a smaller gain.
            gain = slip.omega_gain * slip.yaw_gain if self.on_spot else 1.0
            forward = sign * self._speeds(twists * [[1.0], [0.0]], Slip())
            turning = sign * self._speeds(np.hstack([twists, gain * twists]) * [[0.0], [1.0]], Slip())
            min_command, along = forward.min(axis=1) + turning.min(axis=1), sign[:, 0] * self.actual
            max_command = forward.max(axis=1) + turning.max(axis=1)
            demand = np.minimum(min_command, sign[:, 0] * by_reference)
            shortfall = demand - along
            deficit = math.inf if self.on_spot else np.abs(twists[0]).max() - abs(self.actual.sum()) / 2
            steady = (np.abs(readings - self.actual) < _STEADY * demand) & (deficit > _SLOWER * shortfall)
            is_short = steady & (along > _SHARE * demand) & (shortfall > np.maximum(_SHORT * demand, _MARGIN))
            if is_short.any() and (along <= max_command + _MARGIN).all():
                rank = shortfall + _MARGIN * (np.arange(2) == self.short_wheel)
                wheel = int(np.argmax(np.where(is_short, rank, -np.inf)))
        if wheel is not None and self._is_saturated(wheel, float(min_command[wheel])):
            self.attained, self.slowed = abs(self.actual[wheel]), 0.0
        elif required > _SLOWED * self.allowed:
            self.slowed += self.dt
        growth = _REGAIN[0] * self.attained + _REGAIN[1]
        self.allowed = self.attained + (growth * (self.slowed - _RETRY) if self.slowed > _RETRY else 0.0)
        is_faster = abs(self.actual[self.short_wheel]) > self.attained * (1 + _SHORT) + _MARGIN
        if not self.enabled or is_faster or required < _FAR_BELOW * self.attained or not self.attained < self.max_speed:
            self._clear()

    def _is_saturated(self, wheel: int, command: float) -> bool:
        """Return True if a higher command than at the first shortfall does not increase the speed of the wheel."""
        speed = abs(self.actual[wheel])
        increase, gain = command - self.tried, speed - self.tried_speed
        is_conclusive = increase > _INCREASE * command
        if wheel != self.short_wheel or increase < 0 or (is_conclusive and gain > _GAIN * increase):
            self.short_wheel, self.tried, self.tried_speed = wheel, command, speed
            return False
        return is_conclusive
