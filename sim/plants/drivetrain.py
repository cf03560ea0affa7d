"""From a command that has arrived to torques: firmware, motor drivers with their velocity loops, DC motors."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.plants.twin_parameters import Driver, Firmware, Motor


class CommandShaper:
    """The microcontroller: a first-order lag per channel, then set-points in whole pulses per second.

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


class SpeedObserver:
    """Speed of the four wheels from encoder counts, by a tracking loop with a double pole.

    One raw count per control sample is 0.039 m/s: a driver never reports differences of counts.

    Parameters
    ----------
    bandwidth
        Magnitude of the double pole [rad/s].
    pulse
        Angle of one count [rad].
    step
        Time between two calls [s].
    phase
        (4,) position of each wheel between two counts at angle zero, in counts, 0 to 1.
    """

    def __init__(self, bandwidth: float, pulse: float, step: float, phase: FloatArray) -> None:
        pole = np.exp(-bandwidth * step)
        self._angle_gain = 1 - pole**2
        self._speed_gain = (1 - pole) ** 2 / step
        self._pulse = pulse
        self._step = step
        self._phase = phase
        self.reset()

    def reset(self) -> None:
        """Wheels at rest at angle zero since ever."""
        self._angle = self._counted(np.zeros(4))
        self.speed = np.zeros(4)

    def update(self, angles: FloatArray) -> FloatArray:
        """(4,) speeds [rad/s] after reading the counters at wheel `angles` (4,) [rad]."""
        predicted = self._angle + self._step * self.speed
        error = self._counted(angles) - predicted
        self._angle = predicted + self._angle_gain * error
        self.speed = self.speed + self._speed_gain * error
        return self.speed

    def _counted(self, angles: FloatArray) -> FloatArray:
        return np.asarray(np.floor(angles / self._pulse + self._phase) * self._pulse)


class VelocityLoops:
    """Feed-forward and PI loop per motor with limited duty, and the motor's torque-speed line.

    Parameters
    ----------
    driver, motor
        Gains and motor data.
    pulse
        Angle of one encoder count [rad].
    step
        Time between two calls [s].

    Attributes
    ----------
    supply
        Supply voltage over nominal [-]; the driver does not know it.
    """

    def __init__(self, driver: Driver, motor: Motor, pulse: float, step: float) -> None:
        self._driver = driver
        self._no_load_speed = motor.no_load_speed
        self._stall_torque = [motor.stall_torque * share for share in motor.spread]
        # Slower than one count per control sample or so the counter cannot tell from rest.
        self._rest_speed = pulse / step / 10
        self._step = step
        self.supply = 1.0
        self.reset()

    def reset(self) -> None:
        """Empty integrators."""
        self._integral = [0.0] * 4

    def torque(self, set_points: FloatArray, measured: FloatArray, speeds: FloatArray) -> FloatArray:
        """Motor torques.

        Parameters
        ----------
        set_points
            (4,) wanted wheel speeds [rad/s].
        measured
            (4,) the drivers' own speed estimates [rad/s].
        speeds
            (4,) true wheel speeds [rad/s], which make the back-EMF.

        Returns
        -------
        FloatArray
            (4,) torques at the wheels [N m].
        """
        # Number by number: for four of them arrays take several times as long, ten times a sample.
        torques = []
        proportional, integral = self._driver.proportional_gain, self._step * self._driver.integral_gain
        wheels = zip(set_points.tolist(), measured.tolist(), speeds.tolist(), self._stall_torque, strict=True)
        for i, (set_point, seen, speed, stall_torque) in enumerate(wheels):
            error = set_point - seen
            # At a zero set-point the driver brakes and forgets: otherwise it would hunt for a fraction of a count.
            resting = set_point == 0.0 and abs(seen) < self._rest_speed
            if resting:
                self._integral[i] = 0.0
            wanted = set_point / self._no_load_speed + proportional * error + self._integral[i]
            duty = 0.0 if resting else min(max(wanted, -1.0), 1.0)
            # The integrators stand still while the duty is at its limit.
            if duty == wanted:
                self._integral[i] += integral * error
            torques.append(stall_torque * (self.supply * duty - speed / self._no_load_speed))
        return np.array(torques)
