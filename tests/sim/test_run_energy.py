"""Energy of a run: from true torques, and none where there are no motors."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.turn_costs import load_drive_constants
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.run import Run

STRAIGHT, CURVE = (ConstantTwist(v=0.4, omega=omega, duration=3.0) for omega in (0.0, 1.2))


def driven(reference: ConstantTwist, surface: str = "default", plant: str = "mujoco", **around: str) -> Run:
    return simulate(FeedForward(), make_plant(plant, surface=surface, sensors="perfect", **around), reference)  # type: ignore[arg-type]


def test_a_curve_costs_more_than_the_straight_way_and_grip_more_than_ice() -> None:
    straight, curve, ice = (driven(*case).metrics.energy_j for case in ((STRAIGHT,), (CURVE,), (CURVE, "ice")))
    assert 0 < straight < 0.5 * curve
    assert ice < 0.5 * curve


def test_the_battery_gives_the_work_and_the_heat() -> None:
    run = driven(CURVE)
    constants, counted = load_drive_constants(), run.counted
    assert constants.regeneration
    heat = constants.resistance / constants.torque_per_current**2 * run.motor_square[counted].sum() * run.sample_time
    assert run.metrics.energy_j == pytest.approx(run.metrics.motor_work_j + heat)
    # Mean of the product over a tick is not far from the product of the means.
    rough = (run.motor_torque * run.motor_speed)[counted].sum() * run.sample_time
    assert run.metrics.motor_work_j == pytest.approx(rough, rel=0.05)


def test_what_follows_the_end_of_the_reference_does_not_count() -> None:
    plain, longer = (
        simulate(FeedForward(), make_plant("mujoco", sensors="perfect"), CURVE, extra_time=time).metrics
        for time in (0.0, 1.0)
    )
    assert plain.energy_j == pytest.approx(longer.energy_j, rel=1e-9)


def test_a_plant_without_motors_has_no_energy_and_no_columns_of_it() -> None:
    run = simulate(FeedForward(), KinematicPlant(), STRAIGHT)
    assert math.isnan(run.metrics.energy_j) and math.isnan(run.metrics.motor_work_j)
    assert "energy" not in str(run.metrics)
    assert not [name for name in run.columns if "torque" in name]


def test_columns_of_a_log_hold_the_true_torques() -> None:
    run = driven(CURVE)
    assert "energy" in str(run.metrics)
    names = [f"true_torque_{wheel}_n_m" for wheel in ("fl", "fr", "rl", "rr")]
    assert np.array_equal(np.column_stack([run.columns[name] for name in names]), run.motor_torque)


def test_a_lost_robot_does_not_spoil_the_sum() -> None:
    run = driven(CURVE)
    torn = run.motor_power.copy()
    torn[-1] = np.nan
    assert math.isfinite(replace(run, motor_power=torn).metrics.energy_j)


@pytest.mark.parametrize("around", [{}, {"scenario": "start_offset"}, {"world": "opening"}])
def test_energy_is_counted_with_the_motors_of_the_robot_that_drives(around: dict[str, str]) -> None:
    run = driven(STRAIGHT, plant="mujoco:fsu_bot", **around)
    own, ours = load_drive_constants("fsu_bot"), load_drive_constants()
    assert run.drive == own
    counted = run.counted

    def by(constants) -> float:  # type: ignore[no-untyped-def]
        return float(constants.motor_power(run.motor_power, run.motor_square)[counted].sum() * run.sample_time)

    assert run.metrics.energy_j == pytest.approx(by(own))
    assert run.metrics.energy_j != pytest.approx(by(ours), rel=0.02)


def test_the_robot_named_default_is_the_one_without_a_name() -> None:
    plain, named = driven(CURVE), driven(CURVE, plant="mujoco:default")
    assert np.array_equal(plain.true_pose, named.true_pose) and np.array_equal(plain.motor_torque, named.motor_torque)
    assert named.drive == load_drive_constants() and plain.metrics.energy_j == named.metrics.energy_j


def test_a_robot_file_names_its_motors_writes_out_what_differs_or_has_those_of_the_papers(tmp_path: Path) -> None:
    def drive(words: str):  # type: ignore[no-untyped-def]
        (tmp_path / "r.yaml").write_text(f"description: a robot\n{words}\n")
        return load_simulated_robot(tmp_path / "r.yaml").drive

    ours = load_drive_constants()
    assert drive("") == ours
    assert drive("drive: fsu_bot") == load_drive_constants("fsu_bot")
    assert drive("drive: {resistance: 2.0}") == ours.model_copy(update={"resistance": 2.0})
    with pytest.raises(ConfigError, match=r"r.yaml: .*drive.*did you mean 'fsu_bot'"):
        drive("drive: fsu_bott")
