"""Rates of outcomes of runs with exact confidence intervals, and conformal bounds."""

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
    """Rate of an outcome with its exact two-sided interval at `CONFIDENCE` (Clopper, Pearson, Biometrika 26, 1934)."""

    count: int
    of: int
    low: float
    high: float

    @classmethod
    def of_runs(cls, count: int, total: int) -> Rate:
        """Compute the rate of `count` in `total` runs; raises ValueError if `total` is zero."""
        interval = binomtest(count, total).proportion_ci(CONFIDENCE, method="exact")
        return cls(count, total, float(interval.low), float(interval.high))

    @property
    def share(self) -> float:
        """Observed rate."""
        return self.count / self.of

    def at_least(self, confidence: float) -> float:
        """Compute the one-sided lower bound with this confidence."""
        return float(betaincinv(self.count, self.of - self.count + 1, 1.0 - confidence)) if self.count else 0.0

    @property
    def bound(self) -> float:
        """One-sided upper bound at `CONFIDENCE`; for a count of 0 in n runs it is 1 - 0.05^(1/n), about 3/n."""
        return float(binomtest(self.count, self.of, alternative="less").proportion_ci(CONFIDENCE, method="exact").high)


def conformal_quantile(groups: Sequence[FloatArray], level: float) -> float:
    """Compute an upper bound for a score of a new group that holds with a probability of at least `level`.

    Groups, such as all places of one drive, must be exchangeable, including the new group; scores within a group may be
    dependent. All groups have equal weights, divided among their scores, and the score of the new group is set to
    infinity. For one score per group this is split conformal prediction. The bound is infinite for fewer than
    level / (1 - level) groups. Source: Lee, Barber, Willett, "Distribution-free inference
    with hierarchical data", 2023.

    Parameters
    ----------
    groups
        (n,) scores of each group, not empty; NaN counts as infinite.
    level
        Probability in (0, 1).
    """
    scores = np.concatenate([np.where(np.isnan(group), np.inf, group) for group in groups])
    weights = np.concatenate([np.full(len(group), 1.0 / len(group)) for group in groups]) / (len(groups) + 1)
    order = np.argsort(scores, kind="stable")
    # The tolerance covers rounding errors of the cumulative weights.
    first = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-9))
    return float(scores[order[first]]) if first < len(order) else np.inf
