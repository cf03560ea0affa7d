"""The points that a search tried: which can be used, which none beats, and how much each parameter matters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from diffdrive_mpc.app.tune.optuna_study import needs_optuna
from diffdrive_mpc.bench.campaign.draws import Value

Values = dict[str, Value]
"""Of the parameters, by key of the configuration."""
_TOP, _LEAST_TOP = 0.1, 5


@dataclass(frozen=True)
class Point:
    """A point that was tried.

    Attributes
    ----------
    number
        In the order of asking; 0 are the defaults.
    values
        Of the parameters.
    fidelity
        How many fidelities it was driven with.
    value, error, effort
        Its score with the last of them, 1 being that of the defaults on the same runs; NaN without one.
    first
        Its value with the first fidelity, which every point has that could be driven; else NaN.
    broken
        What does not hold, in words; empty where all does.
    usable
        Whether it came through all fidelities and everything holds.
    """

    number: int
    values: Values
    fidelity: int = 0
    value: float = math.nan
    error: float = math.nan
    effort: float = math.nan
    first: float = math.nan
    broken: str = ""
    usable: bool = False


@dataclass(frozen=True)
class Searched:
    """All points that were tried, in order, and the importance of each parameter, the largest first."""

    points: list[Point]
    importance: dict[str, float]

    @property
    def best(self) -> Point:
        """The usable point with the least objective; the defaults where there is none."""
        return min(self.usable, key=lambda one: (one.value, one.number), default=self.points[0])

    @property
    def usable(self) -> list[Point]:
        """Points that can be used."""
        return [one for one in self.points if one.usable]

    @property
    def front(self) -> list[Point]:
        """Usable points that no other is better than in error and effort, the least error first."""
        ordered = sorted(self.usable, key=lambda one: (one.error, one.effort, one.number))
        return [one for k, one in enumerate(ordered) if all(one.effort < other.effort for other in ordered[:k])]


def importance_of(points: Sequence[Point], distributions: Mapping[str, object]) -> dict[str, float]:
    """How much each parameter decides whether a point is among the best tenth with the first fidelity; adds up to 1.

    PED-ANOVA (Watanabe, Bansal, Hutter, IJCAI 2023). Empty where there are too few points.
    """
    known = [one for one in points if math.isfinite(one.first)]
    if len(known) < 2 * _LEAST_TOP:
        return {}
    optuna = needs_optuna()
    study = optuna.create_study()
    study.add_trials(
        [
            optuna.trial.create_trial(params=one.values, distributions=dict(distributions), value=one.first)
            for one in known
        ]
    )
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=max(_TOP, _LEAST_TOP / len(known)))
    found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(value) for name, value in sorted(found.items(), key=lambda one: -one[1])}
