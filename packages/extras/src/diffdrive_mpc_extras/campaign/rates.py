"""Shares of runs with exact intervals, and conformal bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv
from scipy.stats import binomtest

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.bootstrap import CONFIDENCE


@dataclass(frozen=True)
class Rate:
    """A share of runs with its exact interval (Clopper, Pearson, Biometrika 26, 1934), both sides `CONFIDENCE`."""

    count: int
    of: int
    low: float
    high: float

    @classmethod
    def of_runs(cls, count: int, total: int) -> Rate:
        """Compute the rate of `count` in `total` runs; raise ValueError without runs."""
        interval = binomtest(count, total).proportion_ci(CONFIDENCE, method="exact")
        return cls(count, total, float(interval.low), float(interval.high))

    @property
    def share(self) -> float:
        """Observed share."""
        return self.count / self.of

    def at_least(self, confidence: float) -> float:
        """Compute the one-sided lower bound with this confidence."""
        return float(betaincinv(self.count, self.of - self.count + 1, 1.0 - confidence)) if self.count else 0.0

    @property
    def bound(self) -> float:
        """No larger, with `CONFIDENCE` on this one side; for none of n it is 1 - 0.05^(1/n), about 3/n."""
        return float(binomtest(self.count, self.of, alternative="less").proportion_ci(CONFIDENCE, method="exact").high)


def conformal_quantile(groups: Sequence[FloatArray], level: float) -> float:
    """Bound that a score of a new group keeps with at least the probability `level`.

    Groups, such as all places of one drive, are exchangeable with each other and with the new one; scores inside a
    group may depend on each other. Each group has the same weight, spread over its scores, and the new one lies at
    infinity (Lee, Barber, Willett, "Distribution-free inference with hierarchical data", 2023; with one score a group
    it is split conformal prediction). Infinite where there are fewer than level / (1 - level) groups.

    Parameters
    ----------
    groups
        (n,) scores of each, not empty; NaN counts as infinite.
    level
        In (0, 1).
    """
    scores = np.concatenate([np.where(np.isnan(group), np.inf, group) for group in groups])
    weights = np.concatenate([np.full(len(group), 1.0 / len(group)) for group in groups]) / (len(groups) + 1)
    order = np.argsort(scores, kind="stable")
    # Sums of weights are off by rounding.
    first = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-9))
    return float(scores[order[first]]) if first < len(order) else np.inf
