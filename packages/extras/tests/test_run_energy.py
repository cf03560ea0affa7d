"""Energy of runs: the work of the motors, and what the battery gives for it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant

from diffdrive_mpc import ConfigError
from diffdrive_mpc.sim import Run, make_plant, simulate
from diffdrive_mpc_extras.energy.power_readings import robot_power, run_energy
from diffdrive_mpc_extras.turn_costs import load_drive_constants

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


def test_time_after_the_end_of_the_reference_does_not_count() -> None:
    plain, longer = (
        run_energy(simulate(FeedForward(), make_plant("mujoco", sensors="perfect"), CURVE, extra_time=time))
        for time in (0.0, 1.0)
    )
    assert plain.energy_j == pytest.approx(longer.energy_j, rel=1e-9)


def test_plant_without_motors_has_no_energy() -> None:
    energy = run_energy(simulate(FeedForward(), KinematicPlant(), STRAIGHT))
    assert math.isnan(energy.energy_j) and math.isnan(energy.motor_work_j)


def test_lost_robot_does_not_spoil_the_sum() -> None:
    run = driven(CURVE)
    torn = run.motor_power.copy()
    torn[-1] = np.nan
    assert math.isfinite(run_energy(replace(run, motor_power=torn)).energy_j)


@pytest.mark.parametrize("around", [{}, {"scenario": "start_offset"}, {"plant": "world:opening@mujoco:fsu_bot"}])
def test_energy_is_counted_with_the_motors_of_the_robot_that_drives(around: dict[str, str]) -> None:
    run = driven(STRAIGHT, **({"plant": "mujoco:fsu_bot", "sensors": "power"} | around))
    own, papers = load_drive_constants("fsu_bot"), load_drive_constants()
    counted = run.counted

    def by(constants) -> float:  # type: ignore[no-untyped-def]
        return float(constants.motor_power(run.motor_power, run.motor_square)[counted].sum() * run.sample_time)

    assert run_energy(run).energy_j == pytest.approx(by(own))
    assert run_energy(run, papers).energy_j == pytest.approx(by(papers)) != pytest.approx(by(own), rel=0.02)


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
