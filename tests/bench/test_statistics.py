"""Bootstrap intervals and tails of the statistics of runs."""

import math

import numpy as np
import pytest

from diffdrive_mpc.bench.statistics import BootstrapEstimate, cvar, mean, median


def test_the_tail_is_the_mean_of_the_worst_twentieth() -> None:
    values = np.random.default_rng(0).permutation(np.arange(1.0, 101.0))
    assert cvar(values) == pytest.approx(np.mean([96, 97, 98, 99, 100]))
    # A twentieth of 30 runs is one and a half of them.
    assert cvar(np.arange(1.0, 31.0)) == pytest.approx((30 + 0.5 * 29) / 1.5)
    assert cvar(np.arange(1.0, 11.0)) == 10.0
    assert cvar(np.arange(12.0).reshape(2, 6), axis=-1) == pytest.approx([5.0, 11.0])
    # Of a normal distribution it is density over tail: 2.0627 standard deviations.
    assert cvar(np.random.default_rng(1).normal(size=400_000)) == pytest.approx(2.0627, abs=0.02)


def test_a_bootstrap_interval_is_as_wide_as_theory_says() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, size=400)
    found = BootstrapEstimate.of_runs(values, mean)
    half = 1.96 * np.std(values) / math.sqrt(400)
    assert found.value == pytest.approx(np.mean(values))
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half), abs=0.2 * half)
    assert BootstrapEstimate.of_runs(values, median).value == pytest.approx(np.median(values))
    assert BootstrapEstimate.of_runs(values, mean) == found


def test_few_runs_have_no_interval() -> None:
    assert math.isnan(BootstrapEstimate.of_runs([], mean).value)
    one = BootstrapEstimate.of_runs([3.0], cvar)
    assert (one.value, math.isnan(one.low)) == (3.0, True)
    assert BootstrapEstimate.of_runs([3.0, 3.0], cvar) == BootstrapEstimate(3.0, 3.0, 3.0)
