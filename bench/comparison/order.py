"""Ranking of controllers with the significance of differences."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import COMPARED, by
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray

RESAMPLES, CERTAINTY = 2000, 95.0
"""Number of bootstrap samples, and confidence level of the interval [%]."""
RULE = (
    "Two controllers differ significantly if the mean difference of their position RMSE, paired by trajectory "
    f"and seed, has the same sign in the middle {CERTAINTY:g} % of {RESAMPLES} bootstrap samples of the differences."
)


@dataclass(frozen=True)
class Rank:
    """Controller in the ranking.

    Attributes
    ----------
    name
        Name of the controller.
    rmse, spread
        Mean position RMSE, and standard deviation over seeds of the mean over trajectories [m].
    behind
        (2,) confidence interval of the mean difference from the next better controller [m]; NaN for the best.
    """

    name: str
    rmse: float
    spread: float
    behind: FloatArray

    @property
    def is_significant(self) -> bool:
        """True if the controller is significantly worse than the next better controller."""
        return bool(self.behind[0] > 0)


def interval(differences: FloatArray) -> FloatArray:
    """Compute a bootstrap interval (2,) of the mean of paired `differences` (n,) with a fixed seed."""
    draws = np.random.default_rng(0).integers(len(differences), size=(RESAMPLES, len(differences)))
    tail = (100.0 - CERTAINTY) / 2
    return np.asarray(np.percentile(differences[draws].mean(axis=1), [tail, 100.0 - tail]))


def rank_controllers(rows: DataFrame) -> list[Rank]:
    """Sort controllers by ascending mean position RMSE; controllers with a run without RMSE are omitted."""
    errors = _errors(rows).dropna(axis=1)
    means = errors.mean().sort_values(kind="stable")
    spreads = errors.groupby("seed").mean().std(ddof=0)
    behind = [interval((errors[name] - errors[before]).to_numpy()) for before, name in itertools.pairwise(means.index)]
    intervals = [np.full(2, np.nan), *behind]
    return [Rank(name, means[name], spreads[name], ends) for name, ends in zip(means.index, intervals, strict=False)]


def reversed_pairs(main: DataFrame, others: DataFrame) -> tuple[list[str], list[str]]:
    """Return the pairs whose order differs between two sets of runs: significant in both sets, and other pairs."""
    sets = _errors(main), _errors(others)
    certain: list[str] = []
    uncertain: list[str] = []
    for a, b in itertools.combinations([name for name in sets[0] if name in sets[1]], 2):
        first, second = ((errors[b] - errors[a]).dropna().to_numpy() for errors in sets)
        if np.mean(first) * np.mean(second) < 0:
            is_certain = all(np.prod(interval(differences)) > 0 for differences in (first, second))
            (certain if is_certain else uncertain).append(f"{a} and {b}")
    return certain, uncertain


def order_table(main: DataFrame, others: DataFrame) -> Table:
    """Tabulate the ranking over the seeds of the tables, and over other seeds if there are such runs."""
    rows = []
    for label, runs in (("these", main), ("others", others)):
        for rank, ranked in enumerate(rank_controllers(runs) if len(runs) else [], 1):
            low, high = 1e3 * ranked.behind
            behind = (
                ("-", "-") if rank == 1 else (f"{number(low, 2)} to {number(high, 2)}", _YES[ranked.is_significant])
            )
            errors = (number(1e3 * ranked.rmse, 2), number(1e3 * ranked.spread, 2))
            rows.append((f"{runs['seed'].nunique()} ({label})", ranked.name, *errors, *behind))
    columns = ("seeds", "controller", "position RMSE [mm]", "spread [mm]", "difference from above [mm]", "significant")
    note = f"{RULE} Spread: standard deviation over seeds."
    if len(others):
        certain, uncertain = reversed_pairs(main, others)
        if not certain + uncertain:
            note += " The order is the same over the other seeds."
        if uncertain:
            note += f" Over the other seeds {', '.join(uncertain)} change places without a significant difference."
        if certain:
            note += f" The order of {', '.join(certain)} is reversed over the other seeds."
    return Table("Order", columns, tuple(rows), text_columns=2, note=note)


_YES = {True: "yes", False: "no"}


def _errors(rows: DataFrame) -> DataFrame:
    """Return the position RMSE of each controller (column) on each trajectory with each seed (row)."""
    keys = ["trajectory", "seed"]
    return DataFrame({name: part.set_index(keys)["position_rmse_m"] for name, part in by(rows, COMPARED).items()})
