"""References: the reference clock, invalid shapes, and planners that update every second."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import Controller, Measurement, Stamped, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.reentry.reference_clock import ReferenceClock, settling_profile
from diffdrive_mpc.mpc.trajectories.moved import MovedReference

DT = 0.02
FASTEST, RAMP = 1.25, 1.0
rates, delays = st.floats(0.0, FASTEST), st.floats(-4.0, 8.0)


@given(rates, delays)
def test_delay_is_reduced_to_zero_within_the_bounds(rate, delay):
    profile = settling_profile(rate, delay, 2.0 - FASTEST, FASTEST, RAMP)
    times, values = np.array(profile.times), np.array(profile.rates)
    end = times[-1]
    assert end - float(profile.progress(end)) == pytest.approx(-delay, abs=1e-9)
    assert values[0] == pytest.approx(rate)
    assert values[-1] == 1.0
    assert (values >= -1e-12).all()
    assert values.max() <= max(FASTEST, rate) + 1e-12
    assert (np.abs(np.diff(values)) <= RAMP * np.diff(times) + 1e-9).all()


@given(rates, delays)
def test_progress_is_the_integral_of_the_rate(rate, delay):
    profile = settling_profile(rate, delay, 2.0 - FASTEST, FASTEST, RAMP)
    # The rate is linear between its nodes, so trapezoids on a grid that contains the nodes are exact.
    grid = np.union1d(np.linspace(0.0, profile.times[-1] + 1.0, 301), profile.times)
    integral = np.concatenate(
        [[0.0], np.cumsum(0.5 * np.diff(grid) * (profile.rate(grid[1:]) + profile.rate(grid[:-1])))]
    )
    assert np.abs(profile.progress(grid) - integral).max() < 1e-9


def test_delay_is_reduced_in_minimum_time():
    """The durations equal those of optimal trapezoids."""
    # 0.5 s at an excess rate of at most 0.25: two ramps of 0.25 s gain 0.0625 s; the rest takes 0.4375 / 0.25 s.
    assert settling_profile(1.0, 0.5, 0.75, 1.25, 1.0).times[-1] == pytest.approx(0.5 + 1.75)
    # A delay of 0.04 s is too short to reach the bound: a triangle of area 0.04 has a peak of 0.2.
    assert max(settling_profile(1.0, 0.04, 0.75, 1.25, 1.0).rates) == pytest.approx(1.2)


def run(clock, seconds, max_rate=FASTEST, start=0.0):
    """Run the clock with a robot that permits the rate `max_rate`; return times of the reference, delays and rates."""
    rows = []
    for k in range(round(seconds / DT)):
        time = clock.advance(start + k * DT, driving=True)
        clock.plan(max_rate, catch_up=True)
        rows.append((time, clock.delay, clock.rate))
    return np.array(rows).T


@given(st.floats(0.01, 4.0))
def test_delay_decays_to_zero_and_rate_to_one(delay):
    clock = ReferenceClock(FASTEST, RAMP)
    clock.set(delay, 0.0)
    times, delay_series, rate = run(clock, 4.0 * (delay + 1.0) + 4.0)
    assert (np.diff(times) >= -1e-12).all()
    assert np.diff(times).max() <= FASTEST * DT + 1e-12
    assert delay_series[-1] == 0.0
    assert rate[-1] == 1.0
    assert clock.on_time


@given(rates, delays)
def test_planned_reference_equals_the_tracked_reference(rate, delay):
    clock, reference = ReferenceClock(FASTEST, RAMP), load_trajectory("circle")
    clock.advance(5.0, driving=True)
    clock.set(delay, rate)
    clock.plan(FASTEST, catch_up=True)
    sampled = clock.apply(reference).sample(5.0 + DT * np.arange(1, 60)).pose
    expected = []
    for k in range(1, 60):
        time = clock.advance(5.0 + k * DT, driving=True)
        clock.plan(FASTEST, catch_up=True)
        expected.append(reference.sample([time]).pose[0])
    assert sampled == pytest.approx(np.array(expected), abs=1e-7)


@given(rates, delays)
def test_twist_equals_the_derivative_of_the_slowed_pose(rate, delay):
    clock, reference = ReferenceClock(FASTEST, RAMP), load_trajectory("circle")
    clock.advance(6.0, driving=True)
    clock.set(delay, rate)
    clock.plan(FASTEST, catch_up=True)
    times = 6.0 + np.linspace(0.0, 0.6, 601)
    sample = clock.apply(reference).sample(times)
    yaw_rates = np.diff(sample.pose[:, 2]) / np.diff(times)
    assert yaw_rates == pytest.approx(0.5 * (sample.twist[1:, 1] + sample.twist[:-1, 1]), abs=1e-3)


def test_reference_stops_if_the_robot_is_stopped():
    clock = ReferenceClock(FASTEST, RAMP)
    run(clock, 2.0)
    times, delay_series, _ = run(clock, 1.0, max_rate=0.0, start=2.0)
    assert np.ptp(times[1:]) == pytest.approx(0.0, abs=1e-9)
    assert delay_series[-1] == pytest.approx(0.98, abs=1e-9)


def test_reference_waits_while_not_driving_but_not_before_the_start():
    clock = ReferenceClock(FASTEST, RAMP)
    assert clock.advance(-1.0, driving=False) == -1.0
    assert clock.advance(-0.5, driving=False) == -0.5
    assert clock.delay == 0.0
    assert clock.advance(0.5, driving=False) == 0.0
    assert clock.advance(0.7, driving=False) == pytest.approx(0.0)
    assert clock.delay == pytest.approx(0.7)


def test_rate_rises_no_faster_than_the_ramp_after_a_wait():
    clock = ReferenceClock(FASTEST, RAMP)
    run(clock, 1.0, max_rate=0.0)
    _, _, rate = run(clock, 1.0, max_rate=0.5, start=1.0)
    assert rate[0] == 0.0
    assert (np.diff(rate) <= RAMP * DT + 1e-12).all()
    assert rate[-1] == pytest.approx(0.5)


SLIPPERY = {"surface": "slippery", "sensors": "default", "seed": 4}


def drive_with_planner(each_second, seconds=8.0, t0_of=lambda reference, t: t, **options):
    """Return commands and distances from the path [m]; call `each_second`, if given, once per second."""
    controller = Controller(load_config(overrides=options))
    reference, plant = load_trajectory("circle"), make_plant("mujoco", **SLIPPERY)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, plant.time)
    commands, errors, last_call = [], [], 0.0
    for k in range(round(seconds / plant.sample_time)):
        if each_second and k and plant.time - last_call >= 1.0:
            last_call = plant.time
            each_second(controller, reference, plant.time)
        expected = reference.sample([plant.time]).pose[0]
        errors.append(np.hypot(*(plant.true_pose[:2] - expected[:2])))
        step = controller.step(plant.time, plant.measure())
        commands.append(step.command.copy())
        plant.advance(step.command)
    return np.array(commands), np.array(errors)


def test_switched_reference_keeps_the_estimate():
    """`start` discards the learned slip every second; `switch_reference` keeps it."""
    _, unchanged = drive_with_planner(None)
    _, switched = drive_with_planner(lambda controller, reference, t: controller.switch_reference(reference, 0.0))
    _, restarted = drive_with_planner(lambda controller, reference, t: controller.start(reference, 0.0))
    second_half = slice(len(unchanged) // 2, None)
    rms = [np.sqrt(np.mean(errors[second_half] ** 2)) for errors in (unchanged, switched, restarted)]
    assert rms[1] == rms[0]
    assert rms[2] > 1.5 * rms[1]


def test_switched_reference_starts_its_clock_and_finishes():
    controller, first = Controller(load_config()), load_trajectory("s")
    pose = first.sample([0.0]).pose[0]
    plant = make_plant("model:ssm")
    plant.reset(pose)
    controller.start(first, plant.time)
    for _ in range(60):
        plant.advance(controller.step(plant.time, plant.measure()).command)
    cane = load_trajectory("cane")
    shifted = MovedReference(cane, plant.true_pose - cane.sample([0.0]).pose[0])
    controller.switch_reference(shifted, plant.time)
    assert controller.reference is shifted
    end = plant.time + cane.duration + 4.0
    while plant.time < end:
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
    assert str(step.mode) == "FINISHED"


CONFIG = load_config("ssm")


class UserReference:
    """The circle from a user class, which C cannot sample; `change` modifies samples after `intact_calls` calls."""

    def __init__(self, change, intact_calls=0):
        self.circle, self.change, self.left = load_trajectory("circle"), change, intact_calls
        self.name, self.duration = "own", self.circle.duration

    def sample(self, times):
        self.left -= 1
        sample = self.circle.sample(times)
        return sample if self.left >= 0 else self.change(sample)


def shorten(sample):
    return sample._replace(pose=sample.pose[:-1], twist=sample.twist[:-1])


CHANGES = {
    "one sample short": shorten,
    "no heading": lambda sample: sample._replace(pose=sample.pose[:, :2]),
    "transposed": lambda sample: sample._replace(pose=sample.pose.T),
    "poses as twists": lambda sample: sample._replace(twist=sample.pose),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_start_error_contains_the_expected_shape(change):
    with pytest.raises(ValueError, match=r"reference 'own': (pose|twist) of sample\(times\) has shape .*; expected \("):
        Controller(CONFIG).start(UserReference(change), 0.0)


def steps_at_rest(change, intact_calls=30, ticks=60):
    """Return steps of a robot at rest on its first pose; the reference is faulty after `intact_calls` calls."""
    controller = Controller(CONFIG)
    reference = UserReference(change, intact_calls)
    pose = reference.circle.sample([0.0]).pose[0]
    controller.start(reference, 0.0)
    times = CONFIG.sample_time * np.arange(ticks)
    return [controller.step(t, Measurement(pose=Stamped(pose, t), yaw_rate=Stamped(0.0, t))) for t in times.tolist()]


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_faulty_reference_stops_the_robot_without_exception(change):
    steps = steps_at_rest(change)
    assert steps[1].mode is Mode.TRACKING
    assert "the reference cannot be sampled: reference 'own': " in steps[-1].message
    assert steps[-1].mode in (Mode.BRAKING, Mode.STOPPED)
    assert np.isfinite([step.command for step in steps]).all()
