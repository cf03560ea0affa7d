"""The experiments' commands, and the log of a drive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.open_loop import drive_open_loop, load_command_parameters, random_commands, step_commands

RANDOM = load_command_parameters().random


@given(seed=st.integers(0, 10_000))
def test_random_set_points_stay_in_their_ranges_and_hold_long_enough(seed: int) -> None:
    rows = random_commands(seed, smooth=False)
    assert rows.shape == (round(RANDOM.duration / load_robot().sample_time), 2)
    for column, (low, high) in enumerate((RANDOM.v_range, RANDOM.omega_range)):
        assert rows[:, column].min() >= low
        assert rows[:, column].max() <= high
    changes = np.flatnonzero(np.any(np.diff(rows, axis=0) != 0, axis=1))
    holds = np.diff(changes) * load_robot().sample_time
    slack = load_robot().sample_time
    assert np.all((holds >= RANDOM.hold_range[0] - slack) & (holds <= RANDOM.hold_range[1] + slack))


@given(seed=st.integers(0, 10_000))
def test_smoothing_is_the_mean_of_the_past_window_from_rest(seed: int) -> None:
    rough, smooth = random_commands(seed, smooth=False, duration=5.0), random_commands(seed, duration=5.0)
    window = round(RANDOM.smoothing / load_robot().sample_time)
    padded = np.vstack([np.zeros((window - 1, 2)), rough])
    for k in (0, window // 2, len(rough) // 2, len(rough) - 1):
        np.testing.assert_allclose(smooth[k], padded[k : k + window].mean(axis=0), atol=1e-12)


def test_seeds_fix_random_drives() -> None:
    np.testing.assert_array_equal(random_commands(1), random_commands(1))
    assert not np.array_equal(random_commands(1), random_commands(2))


def test_wheel_steps_turn_the_wheels_at_the_papers_pulse_rates() -> None:
    robot = load_robot()
    kinematics = WheelKinematics(robot.wheel_radius, robot.track)
    rates = [
        kinematics.wheel_speeds(rows)[:, 0].max() * robot.encoder_pulses / (2 * np.pi)
        for rows in step_commands("wheels")
    ]
    np.testing.assert_allclose(rates, [800, 1200, 1500, 1800])


@pytest.mark.parametrize(("kind", "column"), [("v", 0), ("omega", 1), ("wheels", 0)])
def test_steps_start_and_end_at_rest_and_move_one_channel(kind: str, column: int) -> None:
    limits = load_robot().limits
    for rows in step_commands(kind):  # type: ignore[arg-type]
        assert np.all(rows[0] == 0) and np.all(rows[-1] == 0)
        assert np.all(rows[:, 1 - column] == 0)
        assert len(np.unique(rows[:, column])) == 2
        assert np.all(np.abs(rows) <= [limits.v, limits.omega])


def test_log_rows_are_measured_before_their_command_is_sent() -> None:
    plant = make_plant("model:ssm", "ideal", "perfect")
    log = drive_open_loop(plant, np.tile([0.5, 0.0], (5, 1)), pose=[1.0, 2.0, 0.5])
    np.testing.assert_array_equal(log.true_pose[0], [1.0, 2.0, 0.5])
    np.testing.assert_allclose(log.time, np.arange(5) * plant.sample_time)
    assert log.output[0, 0] == 0.0
    assert log.output[1, 0] > 0.0
    assert log.wheel_speeds.shape == (5, 4)


@pytest.mark.parametrize("commands", [np.zeros(3), np.zeros((3, 1)), np.full((3, 2), np.nan)])
def test_log_refuses_bad_commands(commands: np.ndarray) -> None:
    with pytest.raises(ValueError, match="give"):
        drive_open_loop(make_plant("model:ssm"), commands)
