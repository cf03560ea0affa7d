"""The reference's clock: bounded progress, what the plan sees is what comes, and every delay is worked off."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.mpc.reentry.reference_clock import RateProfile, ReferenceClock, settling_profile

DT = 0.02
FASTEST, RAMP = 1.25, 1.0
rates, delays = st.floats(0.0, FASTEST), st.floats(-4.0, 8.0)


@given(rates, delays)
def test_a_delay_is_worked_off_exactly_and_inside_the_bounds(rate, delay):
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
    # The rate is linear between its nodes: with them in the grid the trapezoids are exact.
    fine = np.union1d(np.linspace(0.0, profile.times[-1] + 1.0, 301), profile.times)
    integral = np.concatenate(
        [[0.0], np.cumsum(0.5 * np.diff(fine) * (profile.rate(fine[1:]) + profile.rate(fine[:-1])))]
    )
    assert np.abs(profile.progress(fine) - integral).max() < 1e-9


def test_the_quickest_way_is_taken():
    """No rate inside bounds and ramp makes up a delay faster: the trapezoid of optimal control, by hand."""
    # 0.5 s at most 0.25 ahead: 0.25 s up, 0.25 s down give 0.0625 s; the rest takes 0.4375 / 0.25 s.
    assert settling_profile(1.0, 0.5, 0.75, 1.25, 1.0).times[-1] == pytest.approx(0.5 + 1.75)
    # Too short to reach the bound: a triangle of area 0.04 has a peak of 0.2.
    assert max(settling_profile(1.0, 0.04, 0.75, 1.25, 1.0).rates) == pytest.approx(1.2)


def run(clock, seconds, most=FASTEST, start=0.0):
    """Tick with a robot that allows the rate `most`; returns the reference's times and the delays."""
    out = []
    for k in range(round(seconds / DT)):
        time = clock.advance(start + k * DT, driving=True)
        clock.plan(most, catch_up=True)
        out.append((time, clock.delay, clock.rate))
    return np.array(out).T


def test_on_time_it_is_the_controllers_clock_to_the_last_bit():
    clock = ReferenceClock(FASTEST, RAMP)
    for k in range(1000):
        t = k * 0.0202
        assert clock.advance(t, driving=True) == t
        clock.plan(FASTEST, catch_up=True)
        assert clock.on_time


@given(st.floats(0.01, 4.0))
def test_the_delay_decays_to_zero_and_the_rate_to_one(delay):
    clock = ReferenceClock(FASTEST, RAMP)
    clock.set(delay, 0.0)
    times, behind, rate = run(clock, 4.0 * (delay + 1.0) + 4.0)
    assert (np.diff(times) >= -1e-12).all()
    assert np.diff(times).max() <= FASTEST * DT + 1e-12
    assert behind[-1] == 0.0
    assert rate[-1] == 1.0
    assert clock.on_time


@given(rates, delays)
def test_what_the_plan_sees_is_what_comes(rate, delay):
    clock, reference = ReferenceClock(FASTEST, RAMP), load_trajectory("circle")
    clock.advance(5.0, driving=True)
    clock.set(delay, rate)
    clock.plan(FASTEST, catch_up=True)
    seen = clock.clocked(reference).sample(5.0 + DT * np.arange(1, 60)).pose
    came = []
    for k in range(1, 60):
        time = clock.advance(5.0 + k * DT, driving=True)
        clock.plan(FASTEST, catch_up=True)
        came.append(reference.sample([time]).pose[0])
    assert seen == pytest.approx(np.array(came), abs=1e-7)


@given(rates, delays)
def test_the_twist_is_that_of_the_slowed_motion(rate, delay):
    clock, reference = ReferenceClock(FASTEST, RAMP), load_trajectory("circle")
    clock.advance(6.0, driving=True)
    clock.set(delay, rate)
    clock.plan(FASTEST, catch_up=True)
    times = 6.0 + np.linspace(0.0, 0.6, 601)
    sample = clock.clocked(reference).sample(times)
    turned = np.diff(sample.pose[:, 2]) / np.diff(times)
    assert turned == pytest.approx(0.5 * (sample.twist[1:, 1] + sample.twist[:-1, 1]), abs=1e-3)


def test_it_stands_for_a_robot_that_may_not_go_on():
    clock = ReferenceClock(FASTEST, RAMP)
    run(clock, 2.0)
    times, behind, _ = run(clock, 1.0, most=0.0, start=2.0)
    assert np.ptp(times[1:]) == pytest.approx(0.0, abs=1e-9)
    assert behind[-1] == pytest.approx(0.98, abs=1e-9)


def test_it_stands_while_nobody_drives_but_not_before_the_start():
    clock = ReferenceClock(FASTEST, RAMP)
    assert clock.advance(-1.0, driving=False) == -1.0
    assert clock.advance(-0.5, driving=False) == -0.5
    assert clock.delay == 0.0
    assert clock.advance(0.5, driving=False) == 0.0
    assert clock.advance(0.7, driving=False) == pytest.approx(0.0)
    assert clock.delay == pytest.approx(0.7)


def test_after_waiting_it_picks_up_no_faster_than_the_ramp():
    clock = ReferenceClock(FASTEST, RAMP)
    run(clock, 1.0, most=0.0)
    _, _, rate = run(clock, 1.0, most=0.5, start=1.0)
    assert rate[0] == 0.0
    assert (np.diff(rate) <= RAMP * DT + 1e-12).all()
    assert rate[-1] == pytest.approx(0.5)


def test_a_profile_is_constant_after_its_end():
    profile = RateProfile((0.0, 1.0), (0.0, 1.0), settles=False)
    assert profile.rate([0.5, 1.0, 9.0]) == pytest.approx([0.5, 1.0, 1.0])
    assert profile.progress([0.5, 1.0, 3.0]) == pytest.approx([0.125, 0.5, 2.5])
