"""Power and energy of a drive: predicted from turn costs, and measured where the battery has a topic."""

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

# No robot of this kind has more; a larger value is a broken message.
_MOST_VOLTS, _MOST_AMPERES = 1e3, 1e4
# If the battery was charged on the whole after a drive of this duration, the sign of its current is wrong [s].
_TELLS_AFTER = 3.0


class EnergyMeter:
    """The integral of a power over its stamps, by trapezoids.

    Parameters
    ----------
    longest
        Time between two readings [s] beyond which nothing is counted between them.

    Attributes
    ----------
    energy
        [J].
    counted, missing
        Time that is in it, and that is left out [s].
    gaps
        Number of gaps.
    power
        The last reading [W]; NaN before the first.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self.restart()

    def restart(self) -> None:
        """Restart at zero with the next reading."""
        self.energy = self.counted = self.missing = 0.0
        self.gaps = 0
        self.power = math.nan
        self._last: float | None = None

    def take(self, time: float, power: float) -> None:
        """Add a reading of `power` [W] at `time` [s], later than the previous one."""
        if self._last is not None:
            step = time - self._last
            if step > self._longest:
                self.gaps += 1
                self.missing += step
            else:
                self.energy += 0.5 * (self.power + power) * step
                self.counted += step
        self._last, self.power = time, power


class EnergySettings(PartSettings):
    """Use of the battery's topic."""

    use_battery: bool = Field(
        False,
        description="measure power and energy by `battery_state` (sensor_msgs/BatteryState), for diagnostics [-]",
    )
    battery_discharge_negative: bool = Field(
        True, description="the current is negative while the battery discharges, as in ROS; false: positive [-]"
    )
    battery_timeout: Positive = Field(
        2.0, description="between two readings further apart no energy is counted; an older one is named [s]"
    )


class EnergyPart(NodePart):
    """Power and energy of a drive in diagnostics and recordings: predicted from turn costs, measured by the battery."""

    schema = EnergySettings

    def __init__(self, node: PartHost) -> None:
        super().__init__(node)
        self._settings = EnergySettings()
        self._costs: TurnCosts | None = None
        self.battery = TopicWatch("battery")
        self._measured = EnergyMeter(self._settings.battery_timeout)
        self._drive: Drive | None = None
        self._reading: tuple[float, float] | None = None
        self._begin()

    def configure(self, tools: NodeTools) -> None:
        """Load the turn costs, and subscribe to the battery."""
        settings = self._settings = tools.part_settings(EnergySettings)
        file = energy_settings(tools.controller.config).turn_costs
        self._costs = load_turn_costs(file) if file else None
        self.battery = TopicWatch("battery")
        self._measured = EnergyMeter(settings.battery_timeout)
        self.topics = [self.battery] if settings.use_battery else []
        if settings.use_battery:
            take, refuse = self.take_battery, self.battery.refuse
            self.subscribe(BatteryState, "battery_state", take, qos_profile_sensor_data, refuse, BATTERY_BYTES)

    def activate(self) -> None:
        """Forget readings and energy of the last activation."""
        self.battery.restart()
        self._reading, self._drive = None, None
        self._begin()

    def _begin(self) -> None:
        self._measured.restart()
        self._commands: list[ArrayLike] = []
        self._predicted, self._power = 0.0, math.nan

    @property
    def fault(self) -> str:
        """Reason why the measured energy is not reliable; empty if it is."""
        if not self._settings.use_battery or self.loop is None:
            return ""
        stale = self.battery.fault(self.loop.inbox.now, self._settings.battery_timeout)
        return stale or self.battery.reason or self._wrong_sign

    @property
    def _wrong_sign(self) -> str:
        measured = self._measured
        if measured.counted < _TELLS_AFTER or measured.energy >= 0:
            return ""
        opposite = "false" if self._settings.battery_discharge_negative else "true"
        return (
            f"the drive has charged the battery by {-measured.energy:.1f} J: its current has the other sign; "
            f"set battery_discharge_negative to {opposite}"
        )

    def take_battery(self, message: BatteryState) -> None:
        """Take in a reading of the battery."""
        try:
            voltage, current = float(message.voltage), float(message.current)
            if not (math.isfinite(voltage) and math.isfinite(current)):
                raise MessageError("its voltage or current is no number: the robot does not measure it")
            if not (0 < voltage < _MOST_VOLTS and abs(current) < _MOST_AMPERES):
                raise MessageError(f"{voltage:g} V and {current:g} A are no robot's; is it in V and A?")
            inbox = self.require_tools().inbox
            now, stamp = inbox.now, nanoseconds(message.header.stamp)
            # Drivers of batteries often leave the stamp out.
            time = inbox.time_of(stamp) if stamp else now
            self.battery.accept(time, now, self._settings.battery_timeout)
        except MessageError as error:
            self.battery.refuse(str(error))
            return
        drawn = -current if self._settings.battery_discharge_negative else current
        self._reading = voltage, drawn
        self._measured.take(time, voltage * drawn)

    def after_tick(self, tick: LoopTick, _time: int, row: dict[str, Cell]) -> None:
        """Count the command, and add the last reading of the battery to the row.

        A drive starts at zero energy unless it continues the previous drive.
        """
        drive = None if self.loop is None else self.loop.drive
        if drive is not self._drive:
            self._drive = drive
            if drive is None or not drive.continues:
                self._begin()
        if self._costs is not None:
            self._commands.append(tick.command)
        if self._reading is not None:
            row["battery_voltage_v"], row["battery_current_a"] = self._reading
            self._reading = None

    def diagnostics(self) -> Mapping[str, str]:
        """Return power and energy; commands are converted here, many at once."""
        values: dict[str, str] = {}
        if self.loop is None:
            return values
        if self._costs is not None:
            sample_time = self.require_tools().controller.config.sample_time
            if self._commands:
                power = self._costs.power(np.array(self._commands, dtype=float))
                self._predicted, self._power = self._predicted + float(power.sum()) * sample_time, float(power[-1])
                self._commands = []
            values["power predicted [W]"] = _number(self._power)
            values["energy of this drive predicted [J]"] = f"{self._predicted:.1f}"
        if self._settings.use_battery:
            measured = self._measured
            values["power measured [W]"] = _number(measured.power)
            values["energy of this drive measured [J]"] = f"{measured.energy:.1f}"
            values["battery gaps"] = f"{measured.gaps}, {measured.missing:.1f} s not counted"
        return values


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.1f}"
