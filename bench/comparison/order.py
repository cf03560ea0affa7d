"""Which controller is better than which, and which cannot be told apart."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import COMPARED, by, mean
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray

RESAMPLES, CERTAINTY = 2000, 95.0
"""Of the bootstrap: how often it draws anew, and the share of its means that its interval holds [%]."""
RULE = (
    "Two controllers are told apart where the mean difference of their position RMSE, paired by trajectory "
    f"and seed, has one sign in the middle {CERTAINTY:g} % of {RESAMPLES} bootstrap samples of these differences."
)


@dataclass(frozen=True)
class Rank:
    """One controller in the order.

    Attributes
    ----------
    name
        Of the controller.
    rmse, spread
        Mean position RMSE, and the standard deviation of its means over the trajectories from seed to seed [m].
    behind
        (2,) interval of the mean difference to the controller before it [m]; NaN for the first.
    """

    name: str
    rmse: float
    spread: float
    behind: FloatArray

    @property
    def told_apart(self) -> bool:
        """Whether it is certainly behind the one before it."""
        return bool(self.behind[0] > 0)


def interval(differences: FloatArray) -> FloatArray:
    """(2,) bootstrap interval of the mean of paired `differences` (n,); the same every time."""
    draws = np.random.default_rng(0).integers(len(differences), size=(RESAMPLES, len(differences)))
    tail = (100.0 - CERTAINTY) / 2
    return np.asarray(np.percentile(differences[draws].mean(axis=1), [tail, 100.0 - tail]))


def order(rows: DataFrame) -> list[Rank]:
    """Controllers by mean position RMSE, the best first; those with a run that has none are left out."""
    compared = by(rows, COMPARED)
    errors = {name: _errors(runs) for name, runs in compared.items()}
    ranked = sorted((name for name in errors if np.isfinite(list(errors[name].values())).all()), key=_mean_of(errors))
    places = []
    for before, name in itertools.pairwise(["", *ranked]):
        behind = interval(_differences(errors[before], errors[name])) if before else np.full(2, np.nan)
        means = [mean(runs, "position_rmse_m") for runs in by(compared[name], "seed").values()]
        places.append(Rank(name, _mean_of(errors)(name), float(np.std(means)), behind))
    return places


def reversed_pairs(one: DataFrame, other: DataFrame) -> tuple[list[str], list[str]]:
    """Pairs whose order differs between two sets of runs: those told apart in both, and those that are not."""
    first, second = ({name: _errors(runs) for name, runs in by(runs, COMPARED).items()} for runs in (one, other))
    certain: list[str] = []
    open_: list[str] = []
    for a, b in itertools.combinations([name for name in first if name in second], 2):
        here, there = (_differences(errors[a], errors[b]) for errors in (first, second))
        if np.mean(here) * np.mean(there) < 0:
            apart = all(np.prod(interval(differences)) > 0 for differences in (here, there))
            (certain if apart else open_).append(f"{a} and {b}")
    return certain, open_


def order_table(main: DataFrame, others: DataFrame) -> Table:
    """The order over the seeds of the tables, and over others where they were run."""
    rows = []
    sets = {label: runs for label, runs in (("these", main), ("others", others)) if len(runs)}
    for label, runs in sets.items():
        seeds = len(by(runs, "seed"))
        for rank, place in enumerate(order(runs), 1):
            low, high = 1e3 * place.behind
            behind = "-" if rank == 1 else f"{number(low, 2)} to {number(high, 2)}"
            apart = "-" if rank == 1 else ("yes" if place.told_apart else "no")
            errors = (number(1e3 * place.rmse, 2), number(1e3 * place.spread, 2))
            rows.append((f"{seeds} ({label})", place.name, *errors, behind, apart))
    columns = ("seeds", "controller", "position RMSE [mm]", "spread [mm]", "behind the one above [mm]", "told apart")
    note = f"{RULE} Spread: from seed to seed."
    if len(others):
        certain, open_ = reversed_pairs(main, others)
        same = "The order is the same over the other seeds" if not certain + open_ else ""
        swapped = f"Over the other seeds {', '.join(open_)} change places, which are not told apart" if open_ else ""
        wrong = f"The order of {', '.join(certain)} is reversed over the other seeds" if certain else ""
        note += "".join(f" {sentence}." for sentence in (same, swapped, wrong) if sentence)
    return Table("Order", columns, tuple(rows), text_columns=2, note=note)


def _errors(runs: DataFrame) -> dict[tuple[str, int], float]:
    keys = zip(runs["trajectory"], runs["seed"], strict=True)
    return dict(zip(keys, runs["position_rmse_m"], strict=True))


def _mean_of(errors: dict[str, dict[tuple[str, int], float]]) -> Callable[[str], float]:
    return lambda name: float(np.mean(list(errors[name].values())))


def _differences(one: dict[tuple[str, int], float], other: dict[tuple[str, int], float]) -> FloatArray:
    """Other less one, on what both have driven."""
    return np.array([other[key] - one[key] for key in one if key in other])
