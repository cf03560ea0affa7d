"""Intervals of rates, and conformal quantiles."""

import math

import numpy as np
import pytest
from scipy.stats import binom

from diffdrive_mpc_extras.campaign.rates import Rate, conformal_quantile

TRIALS = 1500
UNLIKELY = 1e-4
"""A right product fails a test with this probability on another seed."""


@pytest.mark.parametrize(("count", "level"), [(19, 0.95), (59, 0.95), (40, 0.8)])
def test_one_score_a_group_covers_with_the_exact_probability(count, level):
    """Split conformal: the k-th of n scores, k = ceil(level (n + 1)), covers with probability k / (n + 1)."""
    stream = np.random.default_rng(1)
    covered = 0
    for scores in stream.lognormal(size=(TRIALS, count + 1)):
        covered += scores[0] <= conformal_quantile(list(scores[1:, None]), level)
    exact = math.ceil(round(level * (count + 1), 9)) / (count + 1)
    low, high = binom.interval(1.0 - UNLIKELY, TRIALS, exact)
    assert low <= covered <= high


def test_groups_of_dependent_scores_cover_at_least_the_level():
    """Places of a drive are nearly the same, drives differ, and some have many more places."""
    stream, level, covered = np.random.default_rng(2), 0.9, 0
    for _ in range(TRIALS):
        groups = [stream.lognormal(sigma=1.0) * stream.uniform(0.8, 1.2, stream.integers(1, 30)) for _ in range(40)]
        covered += stream.choice(groups[0]) <= conformal_quantile(groups[1:], level)
    assert covered >= binom.ppf(UNLIKELY, TRIALS, level)
    # No more than a group beyond it.
    assert covered <= binom.ppf(1.0 - UNLIKELY, TRIALS, level + 1 / 40 + 0.01)


def test_a_group_counts_as_one_however_many_scores_it_has():
    rare = [np.full(1000, 9.0)] + [np.array([float(k)]) for k in range(1, 9)]
    assert conformal_quantile(rare, 0.8) == 8.0


def test_too_few_groups_and_lost_drives_give_no_bound():
    assert conformal_quantile([np.array([1.0])] * 18, 0.95) == math.inf
    assert conformal_quantile([np.array([1.0])] * 19, 0.95) == 1.0
    assert conformal_quantile([np.array([1.0])] * 18 + [np.array([math.nan])], 0.95) == math.inf


@pytest.mark.parametrize(("count", "of"), [(0, 9), (59, 59), (117, 119), (20, 40)])
def test_a_share_is_at_least_what_the_exact_test_does_not_reject(count, of):
    bound = Rate.of_runs(count, of).at_least(0.95)
    assert 0.0 <= bound < count / of or count == bound == 0
    # With the bound as the true share so many or more happen with the probability that is left.
    assert count == 0 or binom.sf(count - 1, of, bound) == pytest.approx(0.05)




@pytest.mark.parametrize(("count", "of"), [(3, 40), (39, 40), (20, 40), (1, 300)])
def test_an_exact_interval_leaves_a_fortieth_on_each_side(count: int, of: int) -> None:
    rate = Rate.of_runs(count, of)
    assert binom.sf(count - 1, of, rate.low) == pytest.approx(0.025)
    assert binom.cdf(count, of, rate.high) == pytest.approx(0.025)
    assert binom.cdf(count, of, rate.bound) == pytest.approx(0.05)


