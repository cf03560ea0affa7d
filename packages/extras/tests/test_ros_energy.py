"""Predicted and measured power and energy in the diagnostics of the node, over DDS."""

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
def test_energy_is_the_trapezoidal_integral_of_the_power(rows):
    steps, power = np.array(rows).T
    meter, time = EnergyMeter(1.0), np.cumsum(steps)
    for instant, value in zip(time.tolist(), power.tolist(), strict=True):
        meter.add(instant, value)
    assert meter.energy == pytest.approx(np.trapezoid(power, time), rel=1e-9, abs=1e-9)
    assert meter.counted == pytest.approx(time[-1] - time[0]) and meter.gaps == 0


def test_gap_is_reported_and_its_energy_is_not_counted():
    meter = EnergyMeter(1.0)
    for time in (0.0, 0.5, 1.0, 5.0, 5.5):
        meter.add(time, 10.0)
    assert (meter.energy, meter.gaps, meter.missing, meter.counted) == (15.0, 1, 4.0, 1.5)


class BatteryStack:
    """Stack with a publisher of the battery and a subscription to the diagnostics of the node."""

    def __init__(self, s):
        self.s, self.statuses = s, []
        node = s.base.node
        self.battery = s.publisher(BatteryState, "battery_state", qos_profile_sensor_data)
        node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda array: self.statuses.append(array.status[0]), 10
        )

    def next_status(self):
        count = len(self.statuses)
        self.s.base.until(lambda: len(self.statuses) > count, "diagnostics")
        return self.statuses[-1]

    def values(self):
        return {pair.key: pair.value for pair in self.next_status().values}

    def publish(self, voltage, current, *, stamp=None):
        message = BatteryState(voltage=float(voltage), current=float(current))
        message.header.stamp = time_message(self.s.base.now if stamp is None else stamp)
        self.battery.publish(message)

    def drive(self, ticks, voltage, current):
        """Run ticks, and wait before each until the node has accepted a battery reading."""
        commands, inbox = [], self.s.node.parts["energy"].battery
        for _ in range(ticks):
            count = inbox.accepted
            self.publish(voltage, current)
            self.s.base.until(lambda count=count: inbox.accepted > count, "a reading")
            commands.append(self.s.base.step())
        return np.array(commands)


@pytest.fixture
def battery(request):
    """Return the stack of a driving robot with a battery."""
    parameters = {"parts.energy.use_battery": True, "diagnostics_rate": 20.0, **getattr(request, "param", {})}
    with stack(drive=True, **parameters) as s:
        yield BatteryStack(s)


@pytest.mark.parametrize("battery", [TURN_COSTS], indirect=True)
def test_diagnostics_contain_predicted_and_measured_energy(battery):
    battery.drive(100, 12.0, -2.0)
    battery.s.base.until(lambda: battery.values()["battery messages"].startswith("100 "), "all readings")
    values = battery.values()
    measured = float(values["energy of this drive measured [J]"])
    assert measured == pytest.approx(24.0 * 99 * DT, rel=0.02)
    assert float(values["power measured [W]"]) == 24.0
    assert values["battery gaps"].startswith("0,")
    commands = np.array(battery.s.base.commands)
    power = load_turn_costs(COSTS).power(commands)
    # The first one or two ticks may precede the drive.
    predicted = float(values["energy of this drive predicted [J]"])
    assert predicted == pytest.approx(power.sum() * DT, rel=0.02, abs=0.06)
    assert float(values["power predicted [W]"]) == pytest.approx(power[-1], abs=0.06)


def test_implausible_battery_readings_are_reported_and_not_counted(battery):
    battery.drive(20, 12.0, -2.0)
    original = battery.values()["energy of this drive measured [J]"]
    battery.publish(12.0, math.nan)
    battery.s.base.until(lambda: "1 refused" in battery.values()["battery messages"], "the refusal")
    status = battery.next_status()
    assert status.level == DiagnosticStatus.WARN and "is not finite" in status.message
    assert battery.values()["energy of this drive measured [J]"] == original
    battery.publish(12000.0, -2.0)
    battery.s.base.until(lambda: "2 refused" in battery.values()["battery messages"], "the refusal")
    assert "the units must be V and A" in battery.values()["battery last refusal"]
    # The robot continues to drive.
    assert battery.s.base.run(20)[-1, 0] > 0.1


@pytest.mark.parametrize("battery", [{"parts.energy.battery_timeout": 0.3}], indirect=True)
def test_missing_battery_messages_are_reported_and_the_gap_is_not_counted(battery):
    battery.drive(10, 12.0, -2.0)
    battery.s.base.run(30)
    assert "battery is 0." in battery.next_status().message and battery.next_status().level == DiagnosticStatus.WARN
    battery.drive(10, 12.0, -2.0)
    battery.s.base.until(lambda: battery.values()["battery messages"].startswith("20 "), "all readings")
    values = battery.values()
    assert values["battery gaps"].startswith("1, 0.6 s")
    assert float(values["energy of this drive measured [J]"]) == pytest.approx(24.0 * 18 * DT, abs=1.0)
    assert "battery" not in battery.next_status().message


def test_recording_contains_the_battery_readings(tmp_path):
    with stack(
        drive=True,
        record=True,
        record_folder=str(tmp_path),
        diagnostics_rate=20.0,
        **{"parts.energy.use_battery": True},
    ) as s:
        battery_stack = BatteryStack(s)
        battery_stack.drive(60, 12.0, -2.0)
        s.base.until(lambda: battery_stack.values()["battery messages"].startswith("60 "), "all readings")
        s.base.run(2)
    (path,) = tmp_path.iterdir()
    columns = read_drive_log(path).columns
    has_reading = np.isfinite(columns["battery_voltage_v"])
    assert has_reading.sum() >= 30  # several readings between two ticks give one row
    assert (columns["battery_voltage_v"][has_reading] == 12.0).all() and (
        columns["battery_current_a"][has_reading] == 2.0
    ).all()
