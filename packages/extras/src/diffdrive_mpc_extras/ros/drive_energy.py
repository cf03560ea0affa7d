"""Power and energy of a drive: predicted from turn costs, and measured where the battery has a topic."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from sensor_msgs.msg import BatteryState

from diffdrive_mpc.models.logs.drive_log.tick import Cell
from diffdrive_mpc.mpc.ros.control_loop import Begun
from diffdrive_mpc.mpc.ros.conversions import MessageError, nanoseconds
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc_extras.turn_costs import TurnCosts

# No robot of this kind has more; what is beyond is a broken message.
_MOST_VOLTS, _MOST_AMPERES = 1e3, 1e4
# A battery that was charged on the whole, after so long a drive, has its sign the other way round [s].
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
        How often something was left out.
    power
        The last reading [W]; NaN before the first.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self.restart()

    def restart(self) -> None:
        """Begin at zero with the next reading."""
        self.energy = self.counted = self.missing = 0.0
        self.gaps = 0
        self.power = math.nan
        self._last: float | None = None

    def take(self, time: float, power: float) -> None:
        """A reading of `power` [W] at `time` [s], later than the one before."""
        if self._last is not None:
            step = time - self._last
            if step > self._longest:
                self.gaps += 1
                self.missing += step
            else:
                self.energy += 0.5 * (self.power + power) * step
                self.counted += step
        self._last, self.power = time, power


class DriveEnergy:
    """What the drive costs, for diagnostics and recordings.

    Parameters
    ----------
    settings
        Whether the battery is heard, its sign and timeout.
    costs
        Turn costs; None where nothing is predicted.
    inbox
        Whose clock counts.
    sample_time
        For which a command holds [s].
    """

    def __init__(self, settings: NodeSettings, costs: TurnCosts | None, inbox: Inbox, sample_time: float) -> None:
        self._settings, self._costs, self._inbox, self._dt = settings, costs, inbox, sample_time
        self.battery = TopicWatch("battery")
        self._measured = EnergyMeter(settings.battery_timeout)
        self._drive: Begun | None = None
        self.restart()

    def restart(self) -> None:
        """The node was activated: nothing has been heard or driven."""
        self.battery.restart()
        self._reading: tuple[float, float] | None = None
        self._begin()

    def _begin(self) -> None:
        self._measured.restart()
        self._commands: list[ArrayLike] = []
        self._predicted, self._power = 0.0, math.nan

    @property
    def topics(self) -> list[TopicWatch]:
        """Those that are heard."""
        return [self.battery] if self._settings.use_battery else []

    @property
    def fault(self) -> str:
        """Why what is measured cannot be relied on, in words; empty if it can."""
        if not self._settings.use_battery:
            return ""
        stale = self.battery.fault(self._inbox.now, self._settings.battery_timeout)
        return stale or self.battery.reason or self._wrong_sign

    @property
    def _wrong_sign(self) -> str:
        measured = self._measured
        if measured.counted < _TELLS_AFTER or measured.energy >= 0:
            return ""
        other = "false" if self._settings.battery_discharge_negative else "true"
        return (
            f"the drive has charged the battery by {-measured.energy:.1f} J: its current has the other sign; "
            f"set battery_discharge_negative to {other}"
        )

    def take_battery(self, message: BatteryState) -> None:
        """Take in a reading of the battery."""
        try:
            voltage, current = float(message.voltage), float(message.current)
            if not (math.isfinite(voltage) and math.isfinite(current)):
                raise MessageError("its voltage or current is no number: the robot does not measure it")
            if not (0 < voltage < _MOST_VOLTS and abs(current) < _MOST_AMPERES):
                raise MessageError(f"{voltage:g} V and {current:g} A are no robot's; is it in V and A?")
            now, stamp = self._inbox.now, nanoseconds(message.header.stamp)
            # Drivers of batteries often leave the stamp out.
            time = self._inbox.time_of(stamp) if stamp else now
            self.battery.accept(time, now, self._settings.battery_timeout)
        except MessageError as error:
            self.battery.refuse(str(error))
            return
        drawn = -current if self._settings.battery_discharge_negative else current
        self._reading = voltage, drawn
        self._measured.take(time, voltage * drawn)

    def tick(self, command: ArrayLike, drive: Begun | None) -> Mapping[str, Cell]:
        """A command (2,) has been sent in this drive; what of a row the battery has told since the last tick.

        A drive begins at zero, unless it goes on from another one.
        """
        if drive is not self._drive:
            self._drive = drive
            if drive is None or not drive.goes_on:
                self._begin()
        if self._costs is not None:
            self._commands.append(command)
        reading, self._reading = self._reading, None
        return {} if reading is None else {"battery_voltage_v": reading[0], "battery_current_a": reading[1]}

    def values(self) -> dict[str, str]:
        """For diagnostics. Commands are turned into energy here, many at once."""
        values = {}
        if self._costs is not None:
            if self._commands:
                power = self._costs.power(np.array(self._commands, dtype=float))
                self._predicted, self._power = self._predicted + float(power.sum()) * self._dt, float(power[-1])
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
