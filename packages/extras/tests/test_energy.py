"""Motor power, identification of the drive constants from a log, and energy predicted before a drive."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.sim import Run, make_plant, simulate
from diffdrive_mpc_extras.energy import identify_constants
from diffdrive_mpc_extras.energy.power_readings import robot_power, run_energy
from diffdrive_mpc_extras.terrain import load_terrain, side_torques
from diffdrive_mpc_extras.torque import TorqueCurves
from diffdrive_mpc_extras.torque.torque_curves import predict_energy
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_vehicle

BOT = load_drive_constants("fsu_bot")
VEHICLE = load_vehicle("fsu_bot")


def test_power_is_the_sum_of_work_and_heat():
    # P4: i = tau / (K_T g eta); each side has two motors.
    current = 2.0 / 2 / (0.023 * 49.8 * 0.76)
    assert BOT.side_power(2.0, 3.0) == pytest.approx(2.0 * 3.0 + 2 * BOT.resistance * current**2)


def test_braking_side_returns_power_only_with_regeneration():
    no_regeneration = BOT.model_copy(update={"regeneration": False})
    assert BOT.side_power(-1.0, 8.0) < 0
    assert no_regeneration.side_power(-1.0, 8.0) == 0.0
    assert no_regeneration.side_power(1.0, 8.0) == BOT.side_power(1.0, 8.0)
    lossy = BOT.model_copy(update={"driver_efficiency": 0.8})
    assert lossy.side_power(-1.0, 8.0) == pytest.approx(0.8 * BOT.side_power(-1.0, 8.0))
    assert lossy.side_power(1.0, 8.0) == pytest.approx(BOT.side_power(1.0, 8.0) / 0.8)


def curves(terrain="asphalt"):
    return TorqueCurves.from_prior(VEHICLE, load_terrain(terrain).model_copy(update={"slip": None}))


def test_turn_needs_more_energy_than_straight_motion_and_energy_is_the_sum_of_power():
    straight, turning = (
        predict_energy(VEHICLE, BOT, curves(), np.tile([0.4, omega], (50, 1)), 0.02) for omega in (0.0, 0.4)
    )
    assert turning.energy > 2 * straight.energy > 0
    assert turning.energy == pytest.approx(turning.power.sum() * 0.02)
    assert straight.power == pytest.approx(2 * BOT.side_power(0.21, 0.4 / 0.1075), rel=0.25)


def test_predicted_energy_agrees_with_the_terrain_of_the_curves():
    torques = side_torques(VEHICLE, load_terrain("asphalt").model_copy(update={"slip": None}), 1.5, 0.4)
    expected = float(
        BOT.side_power(torques.outer, torques.outer_speed)[0] + BOT.side_power(torques.inner, torques.inner_speed)[0]
    )
    predicted = predict_energy(VEHICLE, BOT, curves(), [[0.4, 0.4 / 1.5]], 1.0)
    assert predicted.energy == pytest.approx(expected, rel=0.1)


TRUE_CONSTANTS = BOT.model_copy(update={"torque_constant": 0.03, "resistance": 0.9, "idle_power": 6.0})


def simulate_log(constants=TRUE_CONSTANTS, noise=0.2, count=600, seed=2):
    """Return wheel speeds, side currents (count, 2) and battery readings of a drive with rest, straights and turns."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(-1, 9, (count // 30, 2)), 30, axis=0)
    torque = np.repeat(rng.uniform(-2, 4, (count // 30, 2)), 30, axis=0)
    speed[:60], torque[:60] = 0.0, 0.0
    power = constants.robot_power(torque, speed) + noise * rng.normal(size=count)
    battery = np.stack([np.full(count, 16.0), power / 16.0], -1)
    return speed, torque / constants.torque_per_current, battery


def record(speed, current, battery):
    return Record("log", 0.0, 0.02, np.zeros((len(speed), 2)), wheels=speed, battery=battery, motor_current=current)


@pytest.mark.parametrize("regeneration", [True, False])
def test_identification_returns_the_constants_of_the_simulation(regeneration):
    robot = TRUE_CONSTANTS.model_copy(update={"regeneration": regeneration})
    estimate = identify_constants([record(*simulate_log(robot))], BOT.model_copy(update={"regeneration": regeneration}))
    for name in ("torque_constant", "resistance", "idle_power"):
        value, deviation = getattr(estimate.constants, name), estimate.deviation[name]
        assert abs(value - getattr(robot, name)) < 4 * deviation
        assert deviation < 0.05 * getattr(robot, name)
    # A block averages 15 samples.
    assert estimate.rms == pytest.approx(0.2 / 15**0.5, rel=0.3)


def test_currents_of_four_motors_determine_the_constants_when_front_and_rear_oppose():
    # Front and rear motors oppose each other: the currents of the sides are small, but the motors heat up.
    speed, _, _ = simulate_log(noise=0.0)
    rng = np.random.default_rng(5)
    opposed = np.repeat(rng.uniform(-2, 2, (20, 2)), 30, axis=0)
    common = np.repeat(rng.uniform(-0.5, 2, (20, 2)), 30, axis=0)
    motors = np.hstack([common + opposed, common - opposed])
    speeds = np.tile(speed, 2)
    torque = motors * TRUE_CONSTANTS.torque_per_current
    power = TRUE_CONSTANTS.motor_power(torque * speeds, torque**2)
    battery = np.stack([np.full(len(speed), 16.0), (power.sum(axis=1) + TRUE_CONSTANTS.idle_power) / 16.0], axis=-1)
    sides = record(speed, motors[:, :2] + motors[:, 2:], battery)
    four_motors = replace(sides, motor_currents=motors, wheel_speeds=speeds)
    estimate = identify_constants([four_motors], BOT).constants
    assert estimate.resistance == pytest.approx(TRUE_CONSTANTS.resistance, rel=1e-6)
    assert estimate.torque_constant == pytest.approx(TRUE_CONSTANTS.torque_constant, rel=1e-6)


def test_log_at_rest_or_with_reversed_currents_raises_config_error():
    speed, current, battery = simulate_log()
    with pytest.raises(ConfigError, match="does not separate"):
        identify_constants([record(0 * speed, 0 * current, battery)], BOT)
    with pytest.raises(ConfigError, match="signs and units"):
        identify_constants([record(-speed, current, battery)], BOT)
    with pytest.raises(ConfigError, match="no motors"):
        identify_constants([Record("log", 0.0, 0.02, np.zeros((600, 2)), wheels=speed, battery=battery)], BOT)
    with pytest.raises(ConfigError, match="samples"):
        identify_constants([record(speed[:20], current[:20], battery[:20])], BOT)


STRAIGHT, TURN = (ConstantTwist(v=0.4, omega=omega, duration=3.0) for omega in (0.0, 1.2))


def drive(reference: ConstantTwist, surface: str = "default", plant: str = "mujoco", **changes: str) -> Run:
    options = {"sensors": "perfect"} | changes
    return simulate(FeedForward(), make_plant(plant, surface=surface, **options), reference)  # type: ignore[arg-type]


def test_turn_needs_more_energy_than_straight_motion_and_than_a_turn_on_ice() -> None:
    cases = ((STRAIGHT,), (TURN,), (TURN, "ice"))
    straight, turn, ice = (run_energy(drive(*case)).energy_j for case in cases)
    assert 0 < straight < 0.5 * turn
    assert ice < 0.5 * turn


def test_battery_energy_is_the_sum_of_work_and_heat() -> None:
    run = drive(TURN)
    constants, counted, energy = load_drive_constants(), run.counted, run_energy(run)
    assert constants.regeneration
    heat = constants.resistance / constants.torque_per_current**2 * run.motor_square[counted].sum() * run.sample_time
    assert energy.energy_j == pytest.approx(energy.motor_work_j + heat)
    # Over a tick, the mean of the product is close to the product of the means.
    approximation = (run.motor_torque * run.motor_speed)[counted].sum() * run.sample_time
    assert energy.motor_work_j == pytest.approx(approximation, rel=0.05)


@pytest.mark.parametrize("changes", [{}, {"scenario": "start_offset"}, {"plant": "world:opening@mujoco:fsu_bot"}])
def test_energy_uses_the_motors_of_the_simulated_robot(changes: dict[str, str]) -> None:
    run = drive(STRAIGHT, **({"plant": "mujoco:fsu_bot", "sensors": "power"} | changes))
    robot, paper_constants = load_drive_constants("fsu_bot"), load_drive_constants()
    counted = run.counted

    def expected_energy(constants) -> float:  # type: ignore[no-untyped-def]
        return float(constants.motor_power(run.motor_power, run.motor_square)[counted].sum() * run.sample_time)

    robot_energy = expected_energy(robot)
    assert run_energy(run).energy_j == pytest.approx(robot_energy)
    assert run_energy(run, paper_constants).energy_j == pytest.approx(expected_energy(paper_constants))
    assert expected_energy(paper_constants) != pytest.approx(robot_energy, rel=0.02)


def test_robot_file_sets_motors_by_name_or_changes_the_default_motors(tmp_path: Path) -> None:
    def load_drive(line: str):  # type: ignore[no-untyped-def]
        (tmp_path / "r.yaml").write_text(f"description: a robot\n{line}\n")
        return robot_power(f"mujoco:{tmp_path / 'r.yaml'}").drive

    default, bot = load_drive_constants(), load_drive_constants("fsu_bot")
    assert load_drive("") == default
    assert load_drive("parts: {power: {drive: fsu_bot}}") == bot
    changed = load_drive("parts: {power: {drive: {resistance: 2.0}}}")
    assert changed == default.model_copy(update={"resistance": 2.0})
    with pytest.raises(ConfigError, match=r"r.yaml: .*drive.*did you mean 'fsu_bot'"):
        load_drive("parts: {power: {drive: fsu_bott}}")
