"""Power and energy of a drive: prediction from turn costs, and measurement from the topic of the battery."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState

from diffdrive_mpc.models.logs.drive_log.tick import Cell
from diffdrive_mpc.mpc.ros.control_loop import Drive, LoopTick
from diffdrive_mpc.mpc.ros.conversions import BATTERY_BYTES, MessageError, nanoseconds
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools, PartHost
from diffdrive_mpc.mpc.ros.settings import PartSettings, Positive
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc_extras.energy_term import energy_settings
from diffdrive_mpc_extras.turn_costs import TurnCosts, load_turn_costs

# Plausibility limits of battery readings.
_MAX_VOLTS, _MAX_AMPERES = 1e3, 1e4
_SIGN_CHECK_TIME = 3.0
"""Duration of a drive from which a negative energy indicates a wrong sign of the battery current [s]."""


class EnergyMeter:
    """Integral of the power over time, by the trapezoidal rule.

    Parameters
    ----------
    max_gap
        Time between two readings above which the interval is not integrated [s].

    Attributes
    ----------
    energy
        Energy [J].
    counted, missing
        Total duration of the integrated and of the omitted intervals [s].
    gaps
        Number of omitted intervals.
    power
        Last reading [W]; NaN before the first reading.
    """

    def __init__(self, max_gap: float) -> None:
        self._max_gap = max_gap
        self.restart()

    def restart(self) -> None:
        """Restart at zero with the next reading."""
        self.energy = self.counted = self.missing = 0.0
        self.gaps = 0
        self.power = math.nan
        self._last_time: float | None = None

    def add(self, time: float, power: float) -> None:
        """Add a reading of `power` [W] at `time` [s]; times must increase."""
        if self._last_time is not None:
            step = time - self._last_time
            if step > self._max_gap:
                self.gaps += 1
                self.missing += step
            else:
                self.energy += 0.5 * (self.power + power) * step
                self.counted += step
        self._last_time, self.power = time, power


class EnergySettings(PartSettings):
    """Settings of the battery topic."""

    use_battery: bool = Field(
        False,
        description="measure power and energy by `battery_state` (sensor_msgs/BatteryState), for diagnostics [-]",
    )
    battery_discharge_negative: bool = Field(
        True, description="the current is negative while the battery discharges, as in ROS; false: positive [-]"
    )
    battery_timeout: Positive = Field(
        2.0, description="longest interval between readings that counts; diagnostics report an older reading [s]"
    )


class EnergyPart(NodePart):
    """Predicted and measured power and energy of a drive, for diagnostics and recordings."""

    schema = EnergySettings

    def __init__(self, node: PartHost) -> None:
        super().__init__(node)
        self._settings = EnergySettings()
        self._costs: TurnCosts | None = None
        self.battery = TopicWatch("battery")
        self._meter = EnergyMeter(self._settings.battery_timeout)
        self._drive: Drive | None = None
        self._reading: tuple[float, float] | None = None
        self._reset_energy()

    def configure(self, tools: NodeTools) -> None:
        """Load the turn costs, and subscribe to the battery topic."""
        settings = self._settings = tools.part_settings(EnergySettings)
        file = energy_settings(tools.controller.config).turn_costs
        self._costs = load_turn_costs(file) if file else None
        self.battery = TopicWatch("battery")
        self._meter = EnergyMeter(settings.battery_timeout)
        self.topics = [self.battery] if settings.use_battery else []
        if settings.use_battery:
            callback, refuse = self.on_battery, self.battery.refuse
            self.subscribe(BatteryState, "battery_state", callback, qos_profile_sensor_data, refuse, BATTERY_BYTES)

    def activate(self) -> None:
        """Discard readings and energy of the previous activation."""
        self.battery.restart()
        self._reading, self._drive = None, None
        self._reset_energy()

    def _reset_energy(self) -> None:
        self._meter.restart()
        self._commands: list[ArrayLike] = []
        self._predicted, self._power = 0.0, math.nan

    @property
    def fault(self) -> str:
        """Reason why the measured energy is not reliable; empty without a fault."""
        if not self._settings.use_battery or self.loop is None:
            return ""
        stale = self.battery.fault(self.loop.inbox.now, self._settings.battery_timeout)
        return stale or self.battery.reason or self._sign_fault

    @property
    def _sign_fault(self) -> str:
        meter = self._meter
        if meter.counted < _SIGN_CHECK_TIME or meter.energy >= 0:
            return ""
        opposite = "false" if self._settings.battery_discharge_negative else "true"
        return (
            f"the drive has charged the battery by {-meter.energy:.1f} J: the sign of its current is wrong; "
            f"set battery_discharge_negative to {opposite}"
        )

    def on_battery(self, message: BatteryState) -> None:
        """Check a message of the battery and add its power to the energy."""
        try:
            voltage, current = float(message.voltage), float(message.current)
            if not (math.isfinite(voltage) and math.isfinite(current)):
                raise MessageError("its voltage or current is not finite: the robot does not measure it")
            if not (0 < voltage < _MAX_VOLTS and abs(current) < _MAX_AMPERES):
                raise MessageError(f"{voltage:g} V and {current:g} A are not plausible; the units must be V and A")
            inbox = self.require_tools().inbox
            now, stamp = inbox.now, nanoseconds(message.header.stamp)
            # Battery drivers often omit the stamp.
            time = inbox.time_of(stamp) if stamp else now
            self.battery.accept(time, now, self._settings.battery_timeout)
        except MessageError as error:
            self.battery.refuse(str(error))
            return
        discharge = -current if self._settings.battery_discharge_negative else current
        self._reading = voltage, discharge
        self._meter.add(time, voltage * discharge)

    def after_tick(self, tick: LoopTick, _time: int, row: dict[str, Cell]) -> None:
        """Store the command for the prediction, and add the last battery reading to the row.

        The energy of a drive starts at zero unless the drive continues the previous drive.
        """
        drive = None if self.loop is None else self.loop.drive
        if drive is not self._drive:
            self._drive = drive
            if drive is None or not drive.continues:
                self._reset_energy()
        if self._costs is not None:
            self._commands.append(tick.command)
        if self._reading is not None:
            row["battery_voltage_v"], row["battery_current_a"] = self._reading
            self._reading = None

    def diagnostics(self) -> Mapping[str, str]:
        """Return power and energy; this converts all commands since the last call at once."""
        values: dict[str, str] = {}
        if self.loop is None:
            return values
        if self._costs is not None:
            sample_time = self.require_tools().controller.config.sample_time
            if self._commands:
                power = self._costs.power(np.array(self._commands, dtype=float))
                self._predicted, self._power = self._predicted + float(power.sum()) * sample_time, float(power[-1])
                self._commands = []
            values["power predicted [W]"] = _format_power(self._power)
            values["energy of this drive predicted [J]"] = f"{self._predicted:.1f}"
        if self._settings.use_battery:
            meter = self._meter
            values["power measured [W]"] = _format_power(meter.power)
            values["energy of this drive measured [J]"] = f"{meter.energy:.1f}"
            values["battery gaps"] = f"{meter.gaps}, {meter.missing:.1f} s not counted"
        return values


def _format_power(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.1f}"
