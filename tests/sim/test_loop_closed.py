"""Closed loop: timing of events, and recovery of a disturbed robot."""

import math
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_parts import ConstantTwist, FeedForward, FixedStep, KinematicPlant, run_along
from numpy.typing import ArrayLike

from diffdrive_mpc import Measurement, RobotLostError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.recovery import Recovery, compute_recovery

CIRCLE = ConstantTwist(v=0.5, omega=0.5, duration=3.0, start=(1.0, -2.0, 0.4))


def test_perfect_plant_with_feed_forward_stays_on_the_reference() -> None:
    run = simulate(FeedForward(), KinematicPlant(), CIRCLE)
    assert run.metrics.position_max_m < 1e-12
    assert run.metrics.heading_max_rad < 1e-12
    assert run.metrics.lateral_max_m < 3.2e-6
    assert run.true_pose[0] == pytest.approx([1.0, -2.0, 0.4])


@pytest.mark.parametrize("name", ["controller", "plant"])
def test_controller_and_plant_drive_only_once_at_a_time(name: str) -> None:
    controller, plant = FeedForward(), KinematicPlant()
    second = (controller, KinematicPlant()) if name == "controller" else (FeedForward(), plant)

    def drive_again(_done: int, _total: int) -> None:
        simulate(*second, CIRCLE)

    with pytest.raises(RuntimeError, match=f"another drive uses this {name}: make a {name} for each thread"):
        simulate(controller, plant, CIRCLE, on_tick=drive_again)
    assert simulate(controller, plant, CIRCLE).metrics.completed


class UserPlant(KinematicPlant):
    """User plant with attributes `world` and `disturbance`, like shipped plants in a world."""

    world, disturbance = "the workshop", "a draught"


def test_user_plant_is_not_treated_as_a_plant_in_a_world() -> None:
    run = simulate(FeedForward(), UserPlant(), CIRCLE)
    assert run.metrics.completed and not run.parts and run.disturbance is None


@pytest.mark.parametrize(("duration", "ticks"), [(1.0, 51), (1.001, 52), (0.999, 51), (0.02 * 7, 8)])
def test_last_tick_is_the_first_at_or_after_the_end(duration: float, ticks: int) -> None:
    run = simulate(FeedForward(), KinematicPlant(), ConstantTwist(0.5, 0.0, duration))
    assert len(run.time) == ticks
    assert run.time == pytest.approx(0.02 * np.arange(ticks))


def test_rows_contain_the_state_before_the_command_of_the_tick_acts() -> None:
    run = simulate(FeedForward(), KinematicPlant(), CIRCLE)
    assert run.true_twist[0] == pytest.approx([0.0, 0.0, 0.0])
    assert run.true_twist[1, [0, 2]] == pytest.approx(run.command[0])
    assert run.measured_pose == pytest.approx(run.true_pose)
    assert run.gyro[1:] == pytest.approx(0.5)
    assert np.isnan(run.wheel_speeds).all()


@pytest.mark.parametrize("command", [[np.nan, 0.0], [0.0, np.inf], [0.0], [0.0, 0.0, 0.0]])
def test_command_other_than_two_finite_numbers_ends_the_run(command: list[float]) -> None:
    class FaultyController(FeedForward):
        def step(self, t: float, measurement: Measurement) -> FixedStep:
            return FixedStep(np.array(command))

    with pytest.raises(ValueError, match="two finite numbers"):
        simulate(FaultyController(), KinematicPlant(), CIRCLE)


class FailingPlant(KinematicPlant):
    """Plant that fails in the sample after its tenth tick."""

    def advance(self, command: ArrayLike) -> None:
        if self.time > 9.5 * self.sample_time:
            raise RobotLostError("t = 0.20 s: gone")
        super().advance(command)


def test_run_of_a_lost_robot_is_incomplete_with_metrics_until_the_loss() -> None:
    run, complete_run = (simulate(FeedForward(), plant, CIRCLE) for plant in (FailingPlant(), KinematicPlant()))
    n = 11
    assert (run.ended, complete_run.ended) == ("t = 0.20 s: gone", "")
    assert (run.metrics.completed, complete_run.metrics.completed) == (False, True)
    assert run.metrics.steps == n
    for series in ("time", "true_pose", "true_twist", "command", "step_time", "reference_pose", "measured_pose"):
        np.testing.assert_array_equal(getattr(run, series), getattr(complete_run, series)[:n])
    assert len(run.modes) == len(run.messages) == len(run.measurements) == n
    # This controller solves no problem, and this plant has no motors.
    unknown = ("solve", "iterations", "energy", "motor_work")
    metrics = {name: value for name, value in asdict(run.metrics).items() if not name.startswith(unknown)}
    assert all(np.isfinite(value) for value in metrics.values())
    assert run.metrics.position_max_m == np.max(complete_run.errors.position[:n])


def test_robot_lost_after_the_end_of_its_reference_has_not_completed() -> None:
    short = ConstantTwist(0.5, 0.0, 0.1)
    assert simulate(FeedForward(), FailingPlant(), short).metrics.completed
    assert not simulate(FeedForward(), FailingPlant(), short, extra_time=1.0).metrics.completed


def test_every_tick_is_announced() -> None:
    announced: list[tuple[int, int]] = []
    simulate(FeedForward(), KinematicPlant(), CIRCLE, on_tick=lambda tick, total: announced.append((tick, total)))
    assert announced == [(k + 1, 151) for k in range(151)]


DT, BAND = 0.01, 0.05
TIME = np.arange(0.0, 10.0 + 1e-9, DT)
REST = np.zeros((len(TIME), 2))


def _recovery(
    lateral: FloatArray, disturbance: tuple[float, float] | None, command: FloatArray = REST, *, lost: bool = False
) -> Recovery:
    return compute_recovery(TIME, lateral, command, DT, disturbance, BAND, lost=lost)


def _starting_at(start: float, series: FloatArray) -> FloatArray:
    return np.where(start <= TIME, series, 0.0)


@given(height=st.floats(0.06, 1.0), rate=st.floats(0.5, 5.0), start=st.floats(0.0, 3.0), lasts=st.floats(0.0, 0.5))
def test_exponential_return_recovers_when_it_enters_the_band(
    height: float, rate: float, start: float, lasts: float
) -> None:
    end = start + lasts
    recovery = _recovery(_starting_at(end, height * np.exp(-rate * (TIME - end))), (start, end))
    exact = math.log(height / BAND) / rate
    if end + exact < TIME[-1] - DT:
        assert recovery.recovery_time_s == pytest.approx(exact, abs=DT + 1e-9)
    else:
        assert recovery.recovery_time_s >= TIME[-1] - end - 2 * DT
    assert recovery.overshoot_m == 0.0
    assert 0.0 < height - recovery.lateral_max_m + 1e-12 < height * rate * DT + 1e-9


@given(sign=st.sampled_from([-1.0, 1.0]), height=st.floats(0.1, 0.5), decay=st.floats(0.3, 1.0), w=st.floats(2.0, 5.0))
def test_damped_swing_overshoots_by_its_second_half_wave(sign: float, height: float, decay: float, w: float) -> None:
    lateral = sign * height * np.exp(-decay * TIME) * np.cos(w * TIME)
    recovery = _recovery(lateral, (0.0, 0.0))
    # Extreme of exp(-d t) cos(w t): tan(w t) = -d / w, on the second half wave.
    peak = (math.pi - math.atan(decay / w)) / w
    exact = -height * math.exp(-decay * peak) * math.cos(w * peak)
    assert recovery.overshoot_m == pytest.approx(exact, abs=height * w * DT * 0.1)
    mirrored = _recovery(-lateral, (0.0, 0.0))
    assert mirrored == recovery


@pytest.mark.parametrize(
    ("lateral", "disturbance", "time", "overshoot"),
    [
        (np.where((TIME >= 2) & (TIME < 3), 0.2, 0) - np.where((TIME >= 5) & (TIME < 5.5), 0.06, 0), (2, 2.5), 3, 0.06),
        (0.99 * BAND * np.sin(20 * TIME), (2, 3), 0, 0),
        (_starting_at(2.0, np.full(len(TIME), 0.1)), (2, 2), math.inf, 0),
    ],
    ids=["two excursions", "never outside the band", "ends outside the band"],
)
def test_recovery_counts_from_the_end_of_the_disturbance_to_the_last_departure(lateral, disturbance, time, overshoot):
    recovery = _recovery(lateral, disturbance)
    assert (recovery.recovery_time_s, recovery.overshoot_m) == pytest.approx((time, overshoot))


def test_excursion_is_on_the_side_on_which_the_robot_leaves_the_band() -> None:
    """At the end of a push the robot is still inside the band, on either side; it leaves the band to the left."""
    lateral = _starting_at(2.2, 0.3 * np.exp(-3 * (TIME - 2.2))) + np.where(TIME < 2.2, -0.01, 0.0)
    assert _recovery(lateral, (2.0, 2.1)).overshoot_m == 0.0


def test_recovery_is_undefined_without_a_disturbance_or_with_an_invalid_pose() -> None:
    invalid = np.full(len(TIME), 0.1)
    invalid[5] = np.nan
    for recovery in (_recovery(np.zeros(len(TIME)), None), _recovery(invalid, (0.0, 0.0))):
        assert math.isnan(recovery.recovery_time_s)
        assert math.isnan(recovery.overshoot_m)


def test_lasting_disturbance_has_overshoot_and_max_error_but_no_recovery_time() -> None:
    """The error is first 0.2 m to the left, then 0.07 m to the right: outside the band on both sides."""
    lateral = np.where((TIME >= 2.0) & (TIME < 3.0), 0.2, 0.0) + np.where((TIME >= 5.0) & (TIME < 5.5), -0.07, 0.0)
    recovery = _recovery(lateral, (1.0, math.inf))
    assert math.isnan(recovery.recovery_time_s)
    assert recovery.overshoot_m == pytest.approx(0.07)
    assert recovery.lateral_max_m == pytest.approx(0.2)
    assert _recovery(np.zeros(len(TIME)), (1.0, math.inf)).overshoot_m == 0.0


def test_lost_robot_has_not_recovered_even_inside_the_band() -> None:
    inside = np.full(len(TIME), 0.5 * BAND)
    assert _recovery(inside, (2.0, 3.0)).recovery_time_s == 0.0
    assert _recovery(inside, (2.0, 3.0), lost=True).recovery_time_s == math.inf
    assert math.isnan(_recovery(inside, (2.0, math.inf), lost=True).recovery_time_s)


def test_energy_is_the_integral_of_the_squared_command() -> None:
    command = np.column_stack([np.sin(TIME), 2.0 * np.cos(TIME)])
    recovery = _recovery(np.zeros(len(TIME)), (0.0, 0.0), command)
    assert recovery.command_energy_v == pytest.approx(0.5 * 10 - 0.25 * math.sin(20), abs=3 * DT)
    assert recovery.command_energy_omega == pytest.approx(4 * (0.5 * 10 + 0.25 * math.sin(20)), abs=5 * DT)


def test_command_rate_is_the_rms_of_the_derivative_of_the_command() -> None:
    command = np.column_stack([0.3 * np.sin(2.0 * TIME), np.where(TIME < 5.0, 0.0, 1.0)])
    recovery = _recovery(np.zeros(len(TIME)), (0.0, 0.0), command)
    # The mean square of 0.6 cos(2 t) over 10 s.
    assert recovery.command_rate_v**2 == pytest.approx(0.18 * (1.0 + math.sin(40.0) / 40.0), rel=0.01)
    # One jump of 1 rad/s in n - 1 changes.
    assert recovery.command_rate_omega == pytest.approx(1.0 / DT / math.sqrt(len(TIME) - 1))


def test_robot_far_behind_its_reference_has_only_its_distance_from_the_path_as_lateral_error() -> None:
    """On a circle, the robot is 1.2 m behind and 0.1 m to the left, far outside the window around the reference."""
    circle = ConstantTwist(v=0.5, omega=0.5, duration=12.0)
    times = np.arange(0.0, 12.0, 0.02)
    delay = np.clip(times - 3.0, 0.0, 2.4)  # at rest from 3.0 to 5.4 s
    pose = circle.sample(times - delay).pose
    left = 0.1 * np.column_stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2]), np.zeros(len(pose))])
    run = run_along(circle, pose + left, [0.5, 0.0, 0.5], times)
    assert run.errors.position.max() > 1.0  # the chord
    np.testing.assert_allclose(run.errors.lateral, 0.1, atol=4e-6)


def test_robot_that_catches_up_is_projected_correctly() -> None:
    circle = ConstantTwist(v=0.5, omega=0.5, duration=12.0)
    times = np.arange(0.0, 12.0, 0.02)
    delay = np.clip(times - 2.0, 0.0, 1.6) - np.clip(0.5 * (times - 5.0), 0.0, 1.6)
    run = run_along(circle, circle.sample(times - delay).pose, [0.5, 0.0, 0.5], times)
    assert run.errors.position.max() > 0.7
    assert np.abs(run.errors.lateral).max() < 4e-6
