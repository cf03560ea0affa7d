"""Sensor faults, which change measurements but not the motion of the robot."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Stamped
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.disturbances.disturbance_types import Wheel
from diffdrive_mpc.sim.disturbances.scenario import Scenario

_FIELDS = {"pose": ("pose",), "wheels": ("wheel_twist", "wheel_speeds"), "gyro": ("yaw_rate",)}
"""Fields of a measurement by sensor."""


class SensorFaults:
    """Sensor faults of a scenario: first wrong values, then stuck and missing readings.

    A fault is active if its time window contains the time of delivery of a measurement.

    Parameters
    ----------
    scenario
        Scenario with the sensor faults and their times.
    kinematics
        Kinematics for the conversion of wheel speeds to the twist of a measurement.
    """

    def __init__(self, scenario: Scenario, kinematics: WheelKinematics) -> None:
        self._scenario, self._kinematics = scenario, kinematics
        self.reset()

    def reset(self) -> None:
        """Reset to the state before the first delivery."""
        self._last: dict[str, Any] = {}

    def apply(self, measurement: Measurement, time: float) -> Measurement:
        """Apply the faults at `time` [s] to `measurement`."""
        scenario = self._scenario
        for error in scenario.pose_errors:
            if error.contains(time) and measurement.pose is not None:
                rates = np.array([error.x_rate, error.y_rate, error.heading_rate])
                offset = np.array([error.x, error.y, error.heading]) + (time - error.start) * rates
                measurement = replace(measurement, pose=_shift(measurement.pose, offset))
        for gyro_bias in scenario.gyro_biases:
            if gyro_bias.contains(time) and measurement.yaw_rate is not None:
                rate = np.float64(measurement.yaw_rate.value) + gyro_bias.bias  # type: ignore[arg-type]
                measurement = replace(measurement, yaw_rate=replace(measurement.yaw_rate, value=rate))
        dead_wheels = {
            wheel
            for dead_encoder in scenario.dead_encoders
            if dead_encoder.contains(time)
            for wheel in dead_encoder.wheels
        }
        if dead_wheels and measurement.wheel_speeds is not None and measurement.wheel_twist is not None:
            speeds = np.where([name in dead_wheels for name in get_args(Wheel)], 0.0, measurement.wheel_speeds.value)
            measurement = replace(
                measurement,
                wheel_speeds=replace(measurement.wheel_speeds, value=speeds),
                wheel_twist=replace(measurement.wheel_twist, value=self._kinematics.twist(speeds)),
            )
        stuck_fields = {
            field
            for stuck_sensor in scenario.stuck_sensors
            if stuck_sensor.contains(time)
            for field in _FIELDS[stuck_sensor.sensor]
        }
        missing_fields = {
            field for drop_out in scenario.drop_outs if drop_out.contains(time) for field in _FIELDS[drop_out.sensor]
        }
        changes: dict[str, Any] = {}
        for field in itertools.chain.from_iterable(_FIELDS.values()):
            stamped: Stamped | None = getattr(measurement, field)
            if field in missing_fields or stamped is None:
                changes[field] = None
            elif field in stuck_fields and field in self._last:
                changes[field] = replace(stamped, value=self._last[field])
            else:
                self._last[field] = stamped.value
        return replace(measurement, **changes)


def _shift(pose: Stamped, offset: FloatArray) -> Stamped:
    """Shift a pose by `offset` (3,) x [m], y [m], theta [rad], and wrap its heading into (-pi, pi]."""
    value = np.asarray(pose.value, dtype=float) + offset
    value[2] = -wrap_angle(-value[2])
    return replace(pose, value=value)
