"""Invariants of resampling: no data from outside the log, from the future, or across a gap."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.logs.check_settings import check_settings
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.logs.sampling import (
    RawStretch,
    Signal,
    hold,
    is_increasing,
    resample,
    sample,
    split_at_pauses,
    usual_step,
)

values = st.floats(-1e3, 1e3)


@st.composite
def signals(draw, min_count=1):
    """Draw readings at uneven times from 0 on, sometimes with a long pause."""
    steps = draw(st.lists(st.floats(1e-3, 0.5), min_size=min_count, max_size=40))
    time = np.cumsum(steps)
    value = np.array(draw(st.lists(values, min_size=len(steps), max_size=len(steps))))
    return Signal(time - time[0], value[:, None])


grids = st.tuples(st.floats(0.005, 0.2), st.integers(2, 60))


@given(signals(), grids)
def test_held_value_is_the_mean_of_the_active_values_during_the_sample(signal, grid):
    dt, count = grid
    times = dt * np.arange(count)
    held_values = hold(signal, times, dt, 0.0)
    ends = np.append(signal.time[1:], np.inf)
    for t, value in zip(times, held_values[:, 0], strict=True):
        weights = np.clip(np.minimum(ends, t + dt) - np.maximum(signal.time, t), 0.0, None) / dt
        assert value == pytest.approx(weights @ signal.value[:, 0], rel=1e-9, abs=1e-9 * np.abs(signal.value).max())


@given(signals(), grids, st.floats(0.01, 0.3))
def test_samples_are_between_neighbours_within_reach(signal, grid, reach):
    dt, count = grid
    times = dt * np.arange(count)
    sampled, fresh = sample(signal, times, dt, 0.1 * dt, reach)
    for t, value in zip(times, sampled[:, 0], strict=True):
        is_near = np.abs(signal.time - t) <= 0.1 * dt
        before, after = np.flatnonzero(signal.time <= t), np.flatnonzero(signal.time >= t)
        is_bridged = len(before) and len(after) and signal.time[after[0]] - signal.time[before[-1]] <= reach
        assert np.isfinite(value) == bool(is_near.any() or is_bridged)
        if is_near.any():
            assert value in signal.value[is_near, 0]
        elif is_bridged:
            ends = sorted((signal.value[before[-1], 0], signal.value[after[0], 0]))
            assert ends[0] - 1e-9 <= value <= ends[1] + 1e-9
    assert np.isfinite(sampled[fresh]).all()


@given(signals(), grids, st.floats(0.01, 0.3))
def test_each_fresh_sample_is_near_a_reading(signal, grid, reach):
    dt, count = grid
    times = dt * np.arange(count)
    _, fresh = sample(signal, times, dt, 0.1 * dt, reach)
    assert fresh.sum() <= len(signal.time)
    for t in times[fresh]:
        assert np.abs(signal.time - t).min() <= 0.5 * dt * (1 + 1e-5)


@given(signals(min_count=2), st.floats(0.02, 0.3))
def test_record_does_not_cross_a_gap(signal, max_gap):
    """Every sample of a record is between two adjacent rows."""
    stretch = RawStretch(signal.time, Signal(signal.time, np.hstack([signal.value] * 2)), {"yaw_rate": signal})
    dt = 0.01
    for first, last in split_at_pauses(stretch, max_gap):
        record = resample("log", stretch, first, last, dt, check_settings())
        assert first <= record.start and record.end <= last + 0.1 * dt + 1e-9
        inside = signal.time[(signal.time >= first) & (signal.time <= last)]
        assert (np.diff(inside) <= max_gap).all()
        active = signal.value[(signal.time >= first) & (signal.time <= last), 0]
        # Commands are means of active values, except for rounding.
        deviation = np.maximum(active.min() - record.command[:, 0], record.command[:, 0] - active.max())
        assert deviation.max() <= 1e-9 * np.abs(active).max()


@given(signals(min_count=2))
def test_pieces_contain_each_row_once(signal):
    stretch = RawStretch(signal.time, signal, {})
    ends = list(split_at_pauses(stretch, 0.2))
    counts = [np.count_nonzero((signal.time >= first) & (signal.time <= last)) for first, last in ends]
    assert sum(counts) == len(signal.time)
    assert all(later[0] - earlier[1] > 0.2 for earlier, later in pairwise(ends))


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=50))
def test_increasing_selects_times_later_than_all_previous_times(times):
    selected = np.array(times)[is_increasing(np.array(times))]
    assert (np.diff(selected) > 0).all()
    assert selected[-1] == max(times)


@pytest.mark.parametrize("dt", [0.05, 0.0202, 1 / 120])
def test_usual_step_excludes_gaps(dt):
    time = dt * np.arange(200.0)
    time[100:] += 30.0
    assert usual_step([time]) == pytest.approx(dt, rel=1e-5)


def test_usual_step_is_robust_to_jitter_and_missing_rows():
    rng = np.random.default_rng(2)
    time = 0.02 * np.arange(5000) + rng.uniform(0, 0.004, 5000)
    assert usual_step([time[rng.random(5000) > 0.05]]) == pytest.approx(0.02, rel=1e-4)


def test_part_of_a_record_has_the_same_times():
    record = Record("log", 3.0, 0.1, np.zeros((50, 2)), yaw_rate=np.arange(50.0))
    part = record.part(10, 30)
    assert np.allclose(part.time, record.time[10:30])
    assert np.array_equal(part.yaw_rate, record.yaw_rate[10:30])
    assert len(part.fresh_yaw_rate) == 20
    with pytest.raises(ValueError, match="samples 40 to 60 are outside its 50 samples"):
        record.part(40, 60)


def test_fresh_sample_that_is_not_finite_raises_error():
    gyro = np.where(np.arange(30) == 7, np.nan, 0.0)
    assert not Record("log", 0.0, 0.1, np.zeros((30, 2)), yaw_rate=gyro).fresh_yaw_rate[7]
    with pytest.raises(ValueError, match="yaw_rate holds a value that is not finite"):
        Record("log", 0.0, 0.1, np.zeros((30, 2)), yaw_rate=gyro, fresh_yaw_rate=np.ones(30, dtype=bool))
