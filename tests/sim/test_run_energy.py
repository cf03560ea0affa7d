"""Energy of a run: from true torques, and none where there are no motors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant

from diffdrive_mpc.models.energy import load_drive_constants
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc.sim.run import Run

STRAIGHT, CURVE = (ConstantTwist(v=0.4, omega=omega, duration=3.0) for omega in (0.0, 1.2))


def driven(reference: ConstantTwist, surface: str = "default") -> Run:
    return simulate(FeedForward(), make_plant("mujoco", surface=surface, sensors="perfect"), reference)


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
    from dataclasses import replace

    assert math.isfinite(replace(run, motor_power=torn).metrics.energy_j)
