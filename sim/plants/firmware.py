"""Microcontroller firmware: shapes each command channel and converts it to set-points of the motor drivers."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.plants.twin_parameters import Firmware


class CommandShaper:
    """A first-order lag per channel, then set-points in whole pulses per second.

    Parameters
    ----------
    firmware
        Time constants, gain and the firmware's track.
    robot
        Wheel radius and encoder.
    step
        Time between two calls [s].
    """

    def __init__(self, firmware: Firmware, robot: Robot, step: float) -> None:
        lag = np.array([firmware.lag_v, firmware.lag_omega])
        self._decay = np.exp(-step / lag)
        self._pulse = 2 * np.pi / robot.encoder_pulses
        to_wheels = WheelKinematics(robot.wheel_radius, firmware.track).body_to_wheels
        self._to_pulses = to_wheels * [firmware.gain_v, 1.0] / self._pulse
        self.reset()

    def reset(self) -> None:
        """Zero command since ever."""
        self._state = np.zeros(2)

    def set_points(self, command: FloatArray) -> FloatArray:
        """(4,) wheel set-points [rad/s] for the command (2,) that acts during this step."""
        self._state = command + self._decay * (self._state - command)
        # The drivers take integers: a decaying command ends at exactly zero.
        return np.asarray(np.rint(self._to_pulses @ self._state) * self._pulse)
