"""Power of the motors, its constants from a log, and energy before a drive."""

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


def test_power_is_work_and_heat():
    # P4: i = tau / (K_T g eta), two motors share a side.
    current = 2.0 / 2 / (0.023 * 49.8 * 0.76)
    assert BOT.side_power(2.0, 3.0) == pytest.approx(2.0 * 3.0 + 2 * BOT.resistance * current**2)


def test_a_braking_side_gives_back_or_not():
    without = BOT.model_copy(update={"regeneration": False})
    assert BOT.side_power(-1.0, 8.0) < 0
    assert without.side_power(-1.0, 8.0) == 0.0
    assert without.side_power(1.0, 8.0) == BOT.side_power(1.0, 8.0)
    lossy = BOT.model_copy(update={"driver_efficiency": 0.8})
    assert lossy.side_power(-1.0, 8.0) == pytest.approx(0.8 * BOT.side_power(-1.0, 8.0))
    assert lossy.side_power(1.0, 8.0) == pytest.approx(BOT.side_power(1.0, 8.0) / 0.8)


def curves(terrain="asphalt"):
    return TorqueCurves.from_prior(VEHICLE, load_terrain(terrain).model_copy(update={"slip": None}))


def test_a_turn_costs_more_than_the_straight_way_and_the_sum_is_the_energy():
    straight, turning = (
        predict_energy(VEHICLE, BOT, curves(), np.tile([0.4, omega], (50, 1)), 0.02) for omega in (0.0, 0.4)
    )
    assert turning.energy > 2 * straight.energy > 0
    assert turning.energy == pytest.approx(turning.power.sum() * 0.02)
    assert straight.power == pytest.approx(2 * BOT.side_power(0.21, 0.4 / 0.1075), rel=0.25)


def test_the_prediction_is_that_of_the_terrain_which_the_curves_know():
    torques = side_torques(VEHICLE, load_terrain("asphalt").model_copy(update={"slip": None}), 1.5, 0.4)
    expected = float(
        BOT.side_power(torques.outer, torques.outer_speed)[0] + BOT.side_power(torques.inner, torques.inner_speed)[0]
    )
    predicted = predict_energy(VEHICLE, BOT, curves(), [[0.4, 0.4 / 1.5]], 1.0)
    assert predicted.energy == pytest.approx(expected, rel=0.1)


TRUE = BOT.model_copy(update={"torque_constant": 0.03, "resistance": 0.9, "idle_power": 6.0})


def logged(constants=TRUE, noise=0.2, count=600, seed=2):
    """Simulate currents and speeds of a drive with rest, fast straights and slow turns, and its battery."""
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
def test_constants_are_found_again(regeneration):
    true = TRUE.model_copy(update={"regeneration": regeneration})
    estimate = identify_constants([record(*logged(true))], BOT.model_copy(update={"regeneration": regeneration}))
    for name in ("torque_constant", "resistance", "idle_power"):
        value, deviation = getattr(estimate.constants, name), estimate.deviation[name]
        assert abs(value - getattr(true, name)) < 4 * deviation
        assert deviation < 0.05 * getattr(true, name)
    # Of means over 15 samples.
    assert estimate.rms == pytest.approx(0.2 / 15**0.5, rel=0.3)


def test_four_motors_tell_what_their_sides_hide():
    # Front and rear pull against each other: the sides' sums are small, the heat is not.
    speed, _, _ = logged(noise=0.0)
    rng = np.random.default_rng(5)
    apart = np.repeat(rng.uniform(-2, 2, (20, 2)), 30, axis=0)
    both = np.repeat(rng.uniform(-0.5, 2, (20, 2)), 30, axis=0)
    motors = np.hstack([both + apart, both - apart])
    speeds = np.tile(speed, 2)
    power = TRUE.motor_power(motors * TRUE.torque_per_current * speeds, (motors * TRUE.torque_per_current) ** 2)
    battery = np.stack([np.full(len(speed), 16.0), (power.sum(axis=1) + TRUE.idle_power) / 16.0], axis=-1)
    by_sides = record(speed, motors[:, :2] + motors[:, 2:], battery)
    by_motors = replace(by_sides, motor_currents=motors, wheel_speeds=speeds)
    estimate = identify_constants([by_motors], BOT).constants
    assert estimate.resistance == pytest.approx(TRUE.resistance, rel=1e-6)
    assert estimate.torque_constant == pytest.approx(TRUE.torque_constant, rel=1e-6)


def test_a_drive_at_rest_and_reversed_currents_are_refused():
    speed, current, battery = logged()
    with pytest.raises(ConfigError, match="apart"):
        identify_constants([record(0 * speed, 0 * current, battery)], BOT)
    with pytest.raises(ConfigError, match="signs and units"):
        identify_constants([record(-speed, current, battery)], BOT)
    with pytest.raises(ConfigError, match="no motors"):
        identify_constants([Record("log", 0.0, 0.02, np.zeros((600, 2)), wheels=speed, battery=battery)], BOT)
    with pytest.raises(ConfigError, match="samples"):
        identify_constants([record(speed[:20], current[:20], battery[:20])], BOT)


STRAIGHT, CURVE = (ConstantTwist(v=0.4, omega=omega, duration=3.0) for omega in (0.0, 1.2))


def driven(reference: ConstantTwist, surface: str = "default", plant: str = "mujoco", **around: str) -> Run:
    options = {"sensors": "perfect"} | around
    return simulate(FeedForward(), make_plant(plant, surface=surface, **options), reference)  # type: ignore[arg-type]


def test_curve_costs_more_than_a_straight_line_and_grip_more_than_ice() -> None:
    cases = ((STRAIGHT,), (CURVE,), (CURVE, "ice"))
    straight, curve, ice = (run_energy(driven(*case)).energy_j for case in cases)
    assert 0 < straight < 0.5 * curve
    assert ice < 0.5 * curve


def test_battery_gives_work_and_heat() -> None:
    run = driven(CURVE)
    constants, counted, energy = load_drive_constants(), run.counted, run_energy(run)
    assert constants.regeneration
    heat = constants.resistance / constants.torque_per_current**2 * run.motor_square[counted].sum() * run.sample_time
    assert energy.energy_j == pytest.approx(energy.motor_work_j + heat)
    # Mean of the product over a tick is not far from the product of the means.
    rough = (run.motor_torque * run.motor_speed)[counted].sum() * run.sample_time
    assert energy.motor_work_j == pytest.approx(rough, rel=0.05)


@pytest.mark.parametrize("around", [{}, {"scenario": "start_offset"}, {"plant": "world:opening@mujoco:fsu_bot"}])
def test_energy_is_counted_with_the_motors_of_the_robot_that_drives(around: dict[str, str]) -> None:
    run = driven(STRAIGHT, **({"plant": "mujoco:fsu_bot", "sensors": "power"} | around))
    robot, papers = load_drive_constants("fsu_bot"), load_drive_constants()
    counted = run.counted

    def by(constants) -> float:  # type: ignore[no-untyped-def]
        return float(constants.motor_power(run.motor_power, run.motor_square)[counted].sum() * run.sample_time)

    assert run_energy(run).energy_j == pytest.approx(by(robot))
    assert run_energy(run, papers).energy_j == pytest.approx(by(papers)) != pytest.approx(by(robot), rel=0.02)


def test_robot_file_names_its_motors_writes_out_differences_or_has_those_of_the_papers(tmp_path: Path) -> None:
    def drive(words: str):  # type: ignore[no-untyped-def]
        (tmp_path / "r.yaml").write_text(f"description: a robot\n{words}\n")
        return robot_power(f"mujoco:{tmp_path / 'r.yaml'}").drive

    papers = load_drive_constants()
    assert drive("") == papers
    assert drive("drive: fsu_bot") == drive("parts: {power: {drive: fsu_bot}}") == load_drive_constants("fsu_bot")
    changed = papers.model_copy(update={"resistance": 2.0})
    assert drive("drive: {resistance: 2.0}") == changed
    with pytest.raises(ConfigError, match=r"r.yaml: .*drive.*did you mean 'fsu_bot'"):
        drive("drive: fsu_bott")
