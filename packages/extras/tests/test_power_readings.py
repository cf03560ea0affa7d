"""Simulated sensors of battery and motors: readings, logs, and drive constants identified from these logs."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_parts import ConstantTwist, FeedForward

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.log_csv import write_log as write_csv
from diffdrive_mpc.sim.log_mcap import write_log as write_mcap
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.run import Run
from diffdrive_mpc_extras.energy import identify_constants, logged_energy
from diffdrive_mpc_extras.energy.power_readings import (
    READINGS,
    Battery,
    PowerReadings,
    PowerSensor,
    power_sensor,
    robot_power,
    run_energy,
)
from diffdrive_mpc_extras.torque.measurements import diagnostic_commands
from diffdrive_mpc_extras.turn_costs import DriveConstants, load_drive_constants

EXACT = PowerSensor(**dict.fromkeys(PowerSensor.model_fields, 0.0))
CONSTANTS = ("torque_constant", "resistance", "idle_power")


@given(st.floats(-50.0, 300.0), st.floats(6.0, 50.0), st.floats(0.0, 0.08))
def test_battery_supplies_the_requested_power_up_to_its_maximum(
    power: float, voltage: float, resistance: float
) -> None:
    loaded_voltage, current = Battery(voltage=voltage, resistance=resistance).voltage_and_current(power)
    assert loaded_voltage == pytest.approx(voltage - resistance * current, abs=1e-6 * voltage)
    if power < voltage**2 / (4 * resistance + 1e-12):
        assert loaded_voltage * current == pytest.approx(power, rel=1e-6, abs=1e-6)
        assert loaded_voltage >= 0.5 * voltage


def run(sensors: str) -> Run:
    reference = ConstantTwist(v=0.4, omega=0.5, duration=2.0)
    return simulate(FeedForward(), make_plant("mujoco:fsu_bot", sensors=sensors, seed=4), reference)


@pytest.fixture(scope="module")
def logged_run() -> Run:
    return run("power")


def test_power_sensors_add_columns_and_change_nothing_else(logged_run: Run) -> None:
    default_run = run("default")
    assert not default_run.parts and not set(READINGS) & set(default_run.columns)
    assert np.isfinite(logged_run.parts["power"].readings).all()
    assert list(default_run.columns) == [name for name in logged_run.columns if name not in READINGS]
    for name, column in default_run.columns.items():
        if "step_time" not in name and "solve_time" not in name:
            assert np.array_equal(column, logged_run.columns[name], equal_nan=column.dtype != object), name


def test_noiseless_battery_readings_integrate_to_the_energy_of_the_run() -> None:
    build = load_simulated_robot("fsu_bot")
    power = robot_power("mujoco:fsu_bot")
    part = PowerReadings(EXACT, power.battery, power.drive, 0)
    options = {"robot": build.robot, "twin": build.twin, "firmware": build.firmware}
    plant = MujocoPlant(1.0, build.sensors, parts={"power": part}, **options)
    reference = ConstantTwist(v=0.4, omega=0.5, duration=2.0)
    result = simulate(FeedForward(), plant, reference, extra_time=0.1)
    readings = result.parts["power"].readings
    electric_power = readings[:, :2].prod(axis=1)
    # The reading of a tick covers the sample that ends at this tick.
    counted = np.flatnonzero(result.counted) + 1
    assert electric_power[counted].sum() * result.sample_time == pytest.approx(run_energy(result).energy_j, rel=1e-9)
    assert readings[1:, 2:] == pytest.approx(result.motor_torque[:-1] / power.drive.torque_per_current)


def test_readings_are_multiples_of_the_resolution_and_reproducible_by_seed() -> None:
    sensor = power_sensor()

    def read(seed: int) -> np.ndarray:
        part = PowerReadings(sensor, Battery(), load_drive_constants(), seed)
        return np.array([part.value for _ in range(200) if part.take(np.full((10, 2, 4), 1.0)) is None])

    readings = read(1)
    assert np.array_equal(readings, read(1)) and not np.array_equal(readings, read(2))
    assert np.abs(readings * 100 - np.rint(readings * 100)).max() < 1e-9
    assert readings.std(axis=0) == pytest.approx([0.02, *[0.05] * 5], rel=0.2)


BAG = """
topics:
  command: /cmd_vel
  odometry: /odom
  battery: /battery_state
  motors:
    left: {topic: /motor_currents, fields: [data.0, data.2]}
    right: {topic: /motor_currents, fields: [data.1, data.3]}
wheels: {radius: 0.1075, track: 0.39}
"""


def test_csv_mcap_and_topics_contain_the_same_readings(logged_run: Run, tmp_path: Path) -> None:
    write_csv(logged_run, tmp_path / "log.csv")
    write_mcap(logged_run, tmp_path / "log.mcap")
    (tmp_path / "bag.yaml").write_text(BAG)
    (csv,), (mcap,), (bag,) = (
        read_log(tmp_path / name, *mapping).records
        for name, mapping in (("log.csv", ()), ("log.mcap", ()), ("log.mcap", (tmp_path / "bag.yaml",)))
    )
    assert np.array_equal(csv.battery, logged_run.parts["power"].readings[:, :2])
    assert np.array_equal(csv.motor_currents, logged_run.parts["power"].readings[:, 2:])
    for name in ("battery", "motor_current", "motor_currents"):
        assert np.array_equal(getattr(mcap, name), getattr(csv, name))
        assert getattr(bag, name) == pytest.approx(getattr(csv, name), abs=1e-5)  # BatteryState has single precision
    assert csv.wheels is not None and bag.wheels == pytest.approx(csv.wheels, abs=1e-9)
    assert logged_energy([bag]) == pytest.approx(logged_energy([csv]), rel=1e-6)


SURFACES = [("fsu_bot", "default"), ("fsu_bot", "slippery"), ("default", "default"), ("default", "slippery")]


class TorqueDrive(NamedTuple):
    """Motion and torques of n ticks; both are independent of the readings."""

    dt: float
    command: FloatArray
    speeds: FloatArray
    """(n, 4) wheel speeds from the encoders [rad/s]."""
    motors: FloatArray
    """(n, steps, 2, 4) torques [N m] and wheel speeds [rad/s] in the sample before the tick."""


def drive_torques(plant: MujocoPlant, commands: FloatArray) -> TorqueDrive:
    """Drive the commands (n, 2), and record torque and speed of each motor in each physics step."""
    plant.reset(np.zeros(3))
    speeds, motors = [], []
    last_sample = np.zeros_like(plant.motors)
    for command in commands:
        speeds.append(np.asarray(plant.measure().wheel_speeds.value))
        motors.append(last_sample)
        plant.advance(command)
        last_sample = plant.motors.copy()
    return TorqueDrive(plant.sample_time, commands, np.array(speeds), np.array(motors))


def record(drive: TorqueDrive, constants: DriveConstants, seed: int, battery: Battery | None = None) -> Record:
    """Build the record of the drive with simulated power sensors, for a robot with these constants."""
    part = PowerReadings(power_sensor(), battery or Battery(voltage=16.8, resistance=0.1), constants, seed)
    rows = []
    for motors in drive.motors:
        part.take(motors)
        rows.append(part.value)
    power = np.array(rows)
    sides = 0.5 * (drive.speeds[:, :2] + drive.speeds[:, 2:])
    readings = {"wheels": sides, "wheel_speeds": drive.speeds, "battery": power[:, :2], "motor_currents": power[:, 2:]}
    return Record("drive", 0.0, drive.dt, drive.command, motor_current=power[:, 2:4] + power[:, 4:], **readings)


def draw_constants(nominal: DriveConstants, rng: np.random.Generator) -> DriveConstants:
    """Draw the constants of a robot with the same gears: 0.5 to 2 times the nominal values, idle power 2 to 20 W."""
    torque, resistance = np.exp(rng.uniform(np.log(0.5), np.log(2.0), 2))
    changes = {
        "torque_constant": nominal.torque_constant * torque,
        "resistance": nominal.resistance * resistance,
        "idle_power": rng.uniform(2.0, 20.0),
        "regeneration": bool(rng.random() < 0.5),
        "driver_efficiency": rng.uniform(0.85, 1.0),
    }
    return nominal.model_copy(update=changes)


def diagnostic_drive(robot: str, surface: str, seed: int) -> TorqueDrive:
    """Drive ten turns of different radii for half a minute."""
    commands = diagnostic_commands(
        (400.0, -60.0, 15.0, -8.0, 4.5, -2.8, 1.8, -1.1, 0.8, -0.6), (0.2, 0.6, 0.4), 130, 100
    )
    return drive_torques(make_plant(f"mujoco:{robot}", surface=surface, seed=seed), commands)


def test_errors_of_identified_constants_agree_with_their_deviations() -> None:
    rng, errors = np.random.default_rng(31), []
    for seed, (robot, surface) in enumerate(SURFACES, start=31):
        nominal = robot_power(f"mujoco:{robot}").drive
        drive = diagnostic_drive(robot, surface, seed)
        for k in range(4):
            true_constants = draw_constants(nominal, rng)
            prior = nominal.model_copy(
                update={name: getattr(true_constants, name) for name in ("regeneration", "driver_efficiency")}
            )
            try:
                estimate = identify_constants([record(drive, true_constants, seed=100 * seed + k)], prior)
            except ValueError as error:
                assert "does not separate" in str(error)
                continue
            errors.append(
                [
                    (getattr(estimate.constants, name) - getattr(true_constants, name)) / estimate.deviation[name]
                    for name in CONSTANTS
                ]
            )
    assert len(errors) >= 12
    normalised = np.array(errors)
    assert 0.5 < math.sqrt(np.mean(normalised**2)) < 1.6
    assert np.abs(normalised).max() < 5
