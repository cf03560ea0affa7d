"""Drivetrain from commands to wheel torques: link, firmware, motor drivers with velocity loops, and DC motors.

`sim/core/twin.c` implements the drivetrain; this module computes its parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, checked_array
from diffdrive_mpc.models.robot import Robot, TwistBounds
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.core.library import address, load_twin, view
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.plants.twin_parameters import Driver, Firmware, Motor


class CommandShaper:
    """Firmware with a first-order lag per channel, followed by set-points in whole pulses per second.

    Parameters
    ----------
    firmware
        Time constants, gain and track of the firmware.
    robot
        Wheel radius and encoder.
    step
        Time between two calls [s].
    """

    def __init__(self, firmware: Firmware, robot: Robot, step: float) -> None:
        lag = np.array([firmware.lag_v, firmware.lag_omega])
        pulse = 2 * np.pi / robot.encoder_pulses
        to_wheels = WheelKinematics(robot.wheel_radius, firmware.track).body_to_wheels
        # The gain of omega is part of the firmware's track.
        to_pulses = to_wheels * [firmware.gain_v, 1.0] / pulse
        ffi, self._lib = load_twin()
        decay: list[float] = np.exp(-step / lag).tolist()
        self.c = ffi.new("twin_shaper *", {"decay": decay, "to_pulses": to_pulses.ravel().tolist(), "pulse": pulse})
        self.reset()

    def reset(self) -> None:
        """Reset to the steady state for a zero command."""
        self.c.state = [0.0, 0.0]

    def set_points(self, command: FloatArray) -> FloatArray:
        """Compute wheel set-points (4,) [rad/s] for the effective command (2,) during this step."""
        limited, wheels = np.array(command, dtype=float), np.empty(4)
        self._lib.twin_shape(self.c, address(limited), address(wheels))
        return wheels


class SpeedObserver:
    """Observer of the speeds of the four wheels from encoder counts, with a double pole.

    Differences of counts would be too coarse, since one count per control sample is 0.039 m/s.

    Parameters
    ----------
    bandwidth
        Absolute value of the double pole [rad/s].
    pulse
        Angle of one count [rad].
    step
        Time between two calls [s].
    phase
        (4,) position of each wheel within a count at angle zero, from 0 to 1 [counts].
    """

    def __init__(self, bandwidth: float, pulse: float, step: float, phase: FloatArray) -> None:
        pole = float(np.exp(-bandwidth * step))
        # Gains that place both poles of angle and speed at `pole`.
        gains = {"angle_gain": 1 - pole**2, "speed_gain": (1 - pole) ** 2 / step}
        ffi, self._lib = load_twin()
        self.c = ffi.new("twin_observer *", gains | {"pulse": pulse, "step": step, "phase": phase.tolist()})
        self._speed = view(self.c.speed)
        self.reset()

    @property
    def speed(self) -> FloatArray:
        """(4,) speeds [rad/s] after the last update."""
        return self._speed.copy()

    def reset(self) -> None:
        """Reset to wheels at rest at angle zero."""
        self._lib.twin_reset_observer(self.c)

    def update(self, angles: FloatArray) -> FloatArray:
        """Update the observer with the counts at wheel `angles` (4,) [rad]; return the speeds (4,) [rad/s]."""
        readings = np.array(angles, dtype=float)
        self._lib.twin_observe(self.c, address(readings))
        return self.speed


class VelocityLoops:
    """Velocity loop of each motor, with feed-forward, PI and duty limit, and linear torque-speed curve of the motor.

    Parameters
    ----------
    driver, motor
        Gains and motor data.
    pulse
        Angle of one encoder count [rad].
    step
        Time between two calls [s].
    """

    def __init__(self, driver: Driver, motor: Motor, pulse: float, step: float) -> None:
        ffi, self._lib = load_twin()
        fields = {
            "proportional_gain": driver.proportional_gain,
            "integral_gain": step * driver.integral_gain,
            "no_load_speed": motor.no_load_speed,
            # Below about one count per control sample, motion cannot be distinguished from rest.
            "rest_speed": pulse / step / 10,
            "stall_torque": [motor.stall_torque * ratio for ratio in motor.spread],
            "torque_limit": math.inf if driver.torque_limit is None else driver.torque_limit,
            "supply": 1.0,
        }
        self.c = ffi.new("twin_loops *", fields)
        self.reset()

    @property
    def supply(self) -> float:
        """Ratio of supply voltage to nominal voltage [-]; the driver does not measure the voltage."""
        return float(self.c.supply)

    @supply.setter
    def supply(self, value: float) -> None:
        self.c.supply = value

    def reset(self) -> None:
        """Reset the integrators to zero."""
        self.c.integrator = [0.0] * 4

    def torque(self, set_points: FloatArray, measured: FloatArray, speeds: FloatArray) -> FloatArray:
        """Compute motor torques.

        Parameters
        ----------
        set_points
            (4,) set-points of the wheel speeds [rad/s].
        measured
            (4,) speed estimates of the drivers [rad/s].
        speeds
            (4,) true wheel speeds [rad/s], which determine the back-EMF.

        Returns
        -------
        FloatArray
            (4,) torques at the wheels [N m].
        """
        arrays = [np.array(values, dtype=float) for values in (set_points, measured, speeds)]
        torques = np.empty(4)
        self._lib.twin_torque(self.c, *(address(array) for array in arrays), address(torques))
        return torques


_INITIAL_CAPACITY = 16
"""Initial capacity for pending commands."""


def checked_pose(pose: ArrayLike) -> FloatArray:
    """Return a pose (3,) as an array; raise ArgumentError or ValueError if it is not three finite numbers."""
    value = checked_array("pose", pose, "three numbers", "give x [m], y [m] and theta [rad]")
    if value.shape == (3,) and np.isfinite(value).all():
        return value
    raise ValueError(f"pose {pose!r}: give three finite numbers, x [m], y [m] and theta [rad]")


def clip_command(command: ArrayLike, limits: TwistBounds) -> FloatArray:
    """Clip a command to the range of the link.

    Parameters
    ----------
    command
        (2,) v [m/s], omega [rad/s].
    limits
        Maximum absolute values.

    Returns
    -------
    FloatArray
        (2,) command with each channel clipped to its limit.

    Raises
    ------
    ValueError
        If the command does not consist of two finite numbers.
    """
    value = checked_array("command", command, "two numbers", "give v [m/s] and omega [rad/s]")
    if value.shape == (2,):
        v, omega = value.tolist()
        if math.isfinite(v) and math.isfinite(omega):
            return np.array([_clip(v, limits.v), _clip(omega, limits.omega)])
    raise ValueError(f"command {command!r}: give two finite numbers, v [m/s] and omega [rad/s]")


def _clip(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


class DelayLine:
    """Delay of commands by a dead time; a command is effective until the next command arrives.

    Parameters
    ----------
    dead_time
        Time from sending to arrival [s].
    """

    def __init__(self, dead_time: float) -> None:
        ffi, self._lib = load_twin()
        self.c = ffi.new("twin_link *", {"dead_time": dead_time})
        self._sent = np.zeros(2)
        self._sent_address = address(self._sent)
        self._arrivals, self._commands = np.empty(0), np.empty((0, 2))
        self._reserve(_INITIAL_CAPACITY)

    def reset(self) -> None:
        """Reset to a zero command without pending commands."""
        self.c.first = self.c.count = 0
        self.c.effective = [0.0, 0.0]

    def send(self, time: float, command: FloatArray) -> None:
        """Send `command` (2,) at `time` [s]; times must not decrease."""
        self._sent[:] = command
        if not self._lib.twin_send(self.c, time, self._sent_address):
            self._reserve(2 * self.c.capacity)
            self._lib.twin_send(self.c, time, self._sent_address)

    def mean(self, start: float, end: float) -> FloatArray:
        """Compute the mean (2,) of the effective command over [start, end] [s]; intervals must be in order.

        The mean represents a dead time exactly even if it is not a multiple of the physics step.
        """
        mean = np.empty(2)
        self._lib.twin_mean_command(self.c, start, end, address(mean))
        return mean

    def _reserve(self, capacity: int) -> None:
        """Reserve memory for `capacity` pending commands, and copy the commands that are already pending."""
        arrivals, commands, count = np.empty(capacity), np.empty((capacity, 2)), self.c.count
        if count:
            # The ring buffer is copied in order of arrival, so the new buffer starts at index 0.
            indices = (self.c.first + np.arange(count)) % self.c.capacity
            arrivals[:count], commands[:count] = self._arrivals[indices], self._commands[indices]
        self._arrivals, self._commands = arrivals, commands
        self.c.arrivals, self.c.commands = address(arrivals), address(commands)
        self.c.capacity, self.c.first = capacity, 0


WHEELS = 4


class MotorWork(NamedTuple):
    """Means of motor data over the physics steps of a sample, (4,) each, in the order of the wheels."""

    torque: FloatArray
    """Torque at the wheels [N m]; positive torque drives forward."""
    speed: FloatArray
    """Speed of the wheels [rad/s]."""
    power: FloatArray
    """Mechanical power [W], torque times speed in each step."""
    square: FloatArray
    """Square of the torque [N^2 m^2], which heats the windings."""


NO_WORK = MotorWork(*(np.full(WHEELS, np.nan) for _ in MotorWork._fields))
"""Motor work of a plant without motors."""


def motor_work(plant: Plant) -> MotorWork:
    """Return the motor work of `plant` in the last sample; `NO_WORK` for a plant without motors."""
    motors: FloatArray | None = getattr(plant, "motors", None)
    if motors is None:
        return NO_WORK
    torque, speed = motors[:, 0], motors[:, 1]
    mean_torque, mean_speed = motors.mean(axis=0)
    power, square = (np.einsum("sw,sw->w", torque, factor) / len(motors) for factor in (speed, torque))
    return MotorWork(mean_torque, mean_speed, power, square)


def stack(rows: Sequence[MotorWork]) -> FloatArray:
    """Stack the fields of n samples as an array (4, n, 4)."""
    if all(row is NO_WORK for row in rows):
        return np.full((len(MotorWork._fields), len(rows), WHEELS), np.nan)
    return np.array(rows, dtype=float).reshape(len(rows), len(MotorWork._fields), WHEELS).swapaxes(0, 1)
