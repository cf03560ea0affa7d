"""Power and energy in the node's diagnostics, over DDS: predicted from turn costs, measured by the battery."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rclpy.qos import qos_profile_sensor_data
from ros_parts import DT, stack
from sensor_msgs.msg import BatteryState

from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.mpc.ros.conversions import time_message
from diffdrive_mpc_extras.ros.drive_energy import EnergyMeter
from diffdrive_mpc_extras.turn_costs import load_turn_costs

COSTS = "fsu_bot-slippery"
TURN_COSTS = {"energy.turn_costs": COSTS}


@given(st.lists(st.tuples(st.floats(0.01, 0.9), st.floats(-50.0, 200.0)), min_size=2, max_size=30))
def test_a_meter_is_the_trapezoid_of_what_it_hears(rows):
    steps, power = np.array(rows).T
    meter, time = EnergyMeter(1.0), np.cumsum(steps)
    for instant, value in zip(time.tolist(), power.tolist(), strict=True):
        meter.take(instant, value)
    assert meter.energy == pytest.approx(np.trapezoid(power, time), rel=1e-9, abs=1e-9)
    assert meter.counted == pytest.approx(time[-1] - time[0]) and meter.gaps == 0


def test_nothing_is_counted_in_a_gap_and_it_is_told():
    meter = EnergyMeter(1.0)
    for time in (0.0, 0.5, 1.0, 5.0, 5.5):
        meter.take(time, 10.0)
    assert (meter.energy, meter.gaps, meter.missing, meter.counted) == (15.0, 1, 4.0, 1.5)


class Watched:
    """A stack with a battery, and what /diagnostics says of the node."""

    def __init__(self, s):
        self.s, self.reports = s, []
        node = s.base.node
        self.battery = s.publisher(BatteryState, "battery_state", qos_profile_sensor_data)
        node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda array: self.reports.append(array.status[0]), 10
        )

    def heard(self):
        """Return the next status after the node has received data of the battery."""
        count = len(self.reports)
        self.s.base.until(lambda: len(self.reports) > count, "diagnostics")
        return self.reports[-1]

    def values(self):
        return {pair.key: pair.value for pair in self.heard().values}

    def tell(self, voltage, current, *, stamp=None):
        message = BatteryState(voltage=float(voltage), current=float(current))
        message.header.stamp = time_message(self.s.base.now if stamp is None else stamp)
        self.battery.publish(message)

    def drive(self, ticks, voltage, current):
        """Run ticks with a reading in each; the node has taken it in before the tick."""
        commands, inbox = [], self.s.node.parts["energy"].battery
        for _ in range(ticks):
            count = inbox.accepted
            self.tell(voltage, current)
            self.s.base.until(lambda count=count: inbox.accepted > count, "a reading")
            commands.append(self.s.base.step())
        return np.array(commands)


@pytest.fixture
def battery(request):
    """A robot that drives, with a battery."""
    parameters = {"parts.energy.use_battery": True, "diagnostics_rate": 20.0, **getattr(request, "param", {})}
    with stack(drive=True, **parameters) as s:
        yield Watched(s)


@pytest.mark.parametrize("battery", [TURN_COSTS], indirect=True)
def test_predicted_and_measured_energy_stand_beside_each_other(battery):
    battery.drive(100, 12.0, -2.0)
    battery.s.base.until(lambda: battery.values()["battery messages"].startswith("100 "), "all readings")
    values = battery.values()
    measured = float(values["energy of this drive measured [J]"])
    assert measured == pytest.approx(24.0 * 99 * DT, rel=0.02)
    assert float(values["power measured [W]"]) == 24.0
    assert values["battery gaps"].startswith("0,")
    commands = np.array(battery.s.base.commands)
    power = load_turn_costs(COSTS).power(commands)
    # The first tick or two may be before the drive.
    predicted = float(values["energy of this drive predicted [J]"])
    assert predicted == pytest.approx(power.sum() * DT, rel=0.02, abs=0.06)
    assert float(values["power predicted [W]"]) == pytest.approx(power[-1], abs=0.06)


def test_implausible_battery_readings_are_named_and_not_counted(battery):
    battery.drive(20, 12.0, -2.0)
    before = battery.values()["energy of this drive measured [J]"]
    battery.tell(12.0, math.nan)
    battery.s.base.until(lambda: "1 refused" in battery.values()["battery messages"], "the refusal")
    status = battery.heard()
    assert status.level == DiagnosticStatus.WARN and "is no number" in status.message
    assert battery.values()["energy of this drive measured [J]"] == before
    battery.tell(12000.0, -2.0)
    battery.s.base.until(lambda: "2 refused" in battery.values()["battery messages"], "the refusal")
    assert "is it in V and A?" in battery.values()["battery last refusal"]
    # The robot drives on.
    assert battery.s.base.run(20)[-1, 0] > 0.1


@pytest.mark.parametrize("battery", [{"parts.energy.battery_timeout": 0.3}], indirect=True)
def test_a_silent_battery_is_named_and_its_gap_is_not_counted(battery):
    battery.drive(10, 12.0, -2.0)
    battery.s.base.run(30)
    assert "battery is 0." in battery.heard().message and battery.heard().level == DiagnosticStatus.WARN
    battery.drive(10, 12.0, -2.0)
    battery.s.base.until(lambda: battery.values()["battery messages"].startswith("20 "), "all readings")
    values = battery.values()
    assert values["battery gaps"].startswith("1, 0.6 s")
    assert float(values["energy of this drive measured [J]"]) == pytest.approx(24.0 * 18 * DT, abs=1.0)
    assert "battery" not in battery.heard().message


def test_the_recording_holds_the_battery_and_what_was_said(tmp_path):
    with stack(
        drive=True,
        record=True,
        record_folder=str(tmp_path),
        diagnostics_rate=20.0,
        **{"parts.energy.use_battery": True},
    ) as s:
        watched = Watched(s)
        watched.drive(60, 12.0, -2.0)
        s.base.until(lambda: watched.values()["battery messages"].startswith("60 "), "all readings")
        s.base.run(2)
    (path,) = tmp_path.iterdir()
    columns = read_drive_log(path).columns
    received = np.isfinite(columns["battery_voltage_v"])
    assert received.sum() >= 30  # several that came between two ticks are one row
    assert (columns["battery_voltage_v"][received] == 12.0).all() and (
        columns["battery_current_a"][received] == 2.0
    ).all()
