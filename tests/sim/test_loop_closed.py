"""The closed loop itself."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, FixedStep, KinematicPlant
from numpy.typing import ArrayLike

from diffdrive_mpc import Measurement, RobotLostError
from diffdrive_mpc.sim import simulate

CIRCLE = ConstantTwist(v=0.5, omega=0.5, duration=3.0, start=(1.0, -2.0, 0.4))


def test_a_perfect_plant_under_feed_forward_stays_on_the_reference() -> None:
    run = simulate(FeedForward(), KinematicPlant(), CIRCLE)
    assert run.metrics.position_max_m < 1e-12
    assert run.metrics.heading_max_rad < 1e-12
    assert run.metrics.lateral_max_m < 3.2e-6
    assert run.true_pose[0] == pytest.approx([1.0, -2.0, 0.4])


class Workshop(KinematicPlant):
    """A user's plant with attributes of its own that are called as those of our plants in a world."""

    world, disturbance = "the workshop", "a draught"


def test_a_plant_of_the_user_is_not_taken_for_one_in_a_world() -> None:
    run = simulate(FeedForward(), Workshop(), CIRCLE)
    assert run.metrics.completed and run.world is None and run.disturbance is None


@pytest.mark.parametrize(("duration", "ticks"), [(1.0, 51), (1.001, 52), (0.999, 51), (0.02 * 7, 8)])
def test_the_last_tick_is_the_first_at_or_after_the_end(duration: float, ticks: int) -> None:
    run = simulate(FeedForward(), KinematicPlant(), ConstantTwist(0.5, 0.0, duration))
    assert len(run.time) == ticks
    assert run.time == pytest.approx(0.02 * np.arange(ticks))


def test_rows_hold_the_state_before_the_command_of_the_tick_acts() -> None:
    run = simulate(FeedForward(), KinematicPlant(), CIRCLE)
    assert run.true_twist[0] == pytest.approx([0.0, 0.0, 0.0])
    assert run.true_twist[1, [0, 2]] == pytest.approx(run.command[0])
    assert run.measured_pose == pytest.approx(run.true_pose)
    assert run.gyro[1:] == pytest.approx(0.5)
    assert np.isnan(run.wheel_speeds).all()


def test_same_seed_same_run_bit_for_bit() -> None:
    first, again = (simulate(FeedForward(), KinematicPlant(0.01, seed=3), CIRCLE) for _ in range(2))
    other = simulate(FeedForward(), KinematicPlant(0.01, seed=4), CIRCLE)
    assert np.array_equal(first.true_pose, again.true_pose)
    assert np.array_equal(first.measured_pose, again.measured_pose)
    assert first.metrics == again.metrics
    assert not np.array_equal(first.measured_pose, other.measured_pose)


@pytest.mark.parametrize("command", [[np.nan, 0.0], [0.0, np.inf], [0.0], [0.0, 0.0, 0.0]])
def test_a_command_that_is_not_two_finite_numbers_ends_the_run(command: list[float]) -> None:
    class Faulty(FeedForward):
        def step(self, t: float, measurement: Measurement) -> FixedStep:
            return FixedStep(np.array(command))

    with pytest.raises(ValueError, match="two finite numbers"):
        simulate(Faulty(), KinematicPlant(), CIRCLE)


class Fragile(KinematicPlant):
    """Is lost in the sample after its tenth tick."""

    def advance(self, command: ArrayLike) -> None:
        if self.time > 9.5 * self.sample_time:
            raise RobotLostError("t = 0.20 s: gone")
        super().advance(command)


def test_a_lost_robot_ends_the_run_incomplete_with_the_figures_of_what_was_driven() -> None:
    run, whole = (simulate(FeedForward(), plant, CIRCLE) for plant in (Fragile(), KinematicPlant()))
    n = 11
    assert (run.ended, whole.ended) == ("t = 0.20 s: gone", "")
    assert (run.metrics.completed, whole.metrics.completed) == (False, True)
    assert run.metrics.steps == n
    for series in ("time", "true_pose", "true_twist", "command", "step_time", "reference_pose", "measured_pose"):
        np.testing.assert_array_equal(getattr(run, series), getattr(whole, series)[:n])
    assert len(run.modes) == len(run.messages) == len(run.measurements) == n
    # It solves nothing, and this plant has no motors.
    unknown = ("solve", "iterations", "energy", "motor_work")
    shown = {name: value for name, value in asdict(run.metrics).items() if not name.startswith(unknown)}
    assert all(np.isfinite(value) for value in shown.values())
    assert run.metrics.position_max_m == np.max(whole.errors.position[:n])


def test_a_robot_that_is_lost_after_the_end_of_its_reference_has_not_completed_either() -> None:
    short = ConstantTwist(0.5, 0.0, 0.1)
    assert simulate(FeedForward(), Fragile(), short).metrics.completed
    assert not simulate(FeedForward(), Fragile(), short, extra_time=1.0).metrics.completed


@pytest.mark.parametrize("extra", [-1.0, np.nan, np.inf])
def test_extra_time_must_be_a_time(extra: float) -> None:
    with pytest.raises(ValueError, match="extra_time"):
        simulate(FeedForward(), KinematicPlant(), CIRCLE, extra_time=extra)


def test_every_tick_is_announced() -> None:
    seen: list[tuple[int, int]] = []
    simulate(FeedForward(), KinematicPlant(), CIRCLE, on_tick=lambda done, total: seen.append((done, total)))
    assert seen == [(k + 1, 151) for k in range(151)]


def test_sim_has_no_other_names() -> None:
    from diffdrive_mpc import sim

    with pytest.raises(AttributeError, match="no attribute 'robot'"):
        sim.robot  # noqa: B018
