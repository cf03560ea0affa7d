"""The verdict: the chosen point beside the defaults, on runs that the search has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.app.tune.objective import (
    ObjectiveScore,
    ObjectiveTerm,
    broken,
    exceeded,
    in_words,
    score,
    table_of,
    terms_of,
)
from diffdrive_mpc.app.tune.search import ConfigurationSearch, RunSet, TunePoint
from diffdrive_mpc.app.tune.tune_file import TunePlan
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.statistics import BootstrapEstimate
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.campaign.draws import Value


@dataclass(frozen=True)
class PutBack:
    """What the objective and its sides rise by where one parameter of the chosen point is that of the defaults [-]."""

    key: str
    value: Value
    usual: Value
    rise: BootstrapEstimate
    error: BootstrapEstimate
    effort: BootstrapEstimate


@dataclass(frozen=True)
class TermFigure:
    """A term of the objective: its figure for the defaults and for the chosen point, and the ratio of the two [-]."""

    term: ObjectiveTerm
    usual: float
    mine: float
    ratio: BootstrapEstimate


@dataclass(frozen=True)
class TuneVerdict:
    """What the chosen point is worth.

    Attributes
    ----------
    runs
        How many runs of their own seeds each was driven with.
    gain
        By which share the objective is below that of the defaults, paired run by run [-].
    error, effort
        Its sides, 1 being those of the defaults.
    figures
        Each term of the objective, figures in the unit of its column.
    broken, usual_broken
        What does not hold for the chosen point and for the defaults on these runs, in words; empty where all does.
    put_back
        What each parameter is worth.
    """

    runs: int
    gain: BootstrapEstimate
    error: BootstrapEstimate
    effort: BootstrapEstimate
    figures: list[TermFigure]
    broken: str
    usual_broken: str
    put_back: list[PutBack]

    @property
    def improved(self) -> bool:
        """Whether all holds, and the interval of the gain lies above zero or the defaults break something."""
        return not self.broken and (self.gain.low > 0.0 or self.usual_broken != "")

    @property
    def sentence(self) -> str:
        """What came of it, in one line."""
        on = f"on {self.runs} runs of other seeds"
        of = f"95 % interval {100 * self.gain.low:.1f} to {100 * self.gain.high:.1f} %"
        by = f"{100 * abs(self.gain.value):.1f} % {'below' if self.gain.value >= 0.0 else 'above'} that of the defaults"
        if self.gain == BootstrapEstimate(0.0, 0.0, 0.0):
            also = f"; the defaults break {self.usual_broken}" if self.usual_broken else ""
            return f"no better than the defaults: none of the points that were tried is{also}"
        if self.broken:
            return f"no better than the defaults: {on} the best point breaks {self.broken}"
        if not self.improved:
            return f"no better than the defaults: {on} the objective of the best point is {by} ({of})"
        also = f"; the defaults break {self.usual_broken}, it does not" if self.usual_broken else ""
        return f"the objective is {by} {on} ({of}){also}"


def judge(plan: TunePlan, search: ConfigurationSearch, chosen: TunePoint, bar: ProgressBar) -> TuneVerdict:
    """Drive the chosen point and the defaults with the seeds of the verdict.

    Raises StudyFailedError if runs could not be driven.
    """
    terms, runs = terms_of(plan.objective), search.verdict_runs(plan.verdict.runs)
    usual, mine = search.drive([{}, chosen.values], runs, bar, "driving the verdict")
    theirs, ours = table_of(terms, usual), table_of(terms, mine)
    own = {name: search.with_usual(one, bar) for name, one in search.constraint_sets(plan.verdict).items()}
    constrained = {
        name: search.drive([chosen.values], one.runs, bar, f"constraint {name}")[0] for name, one in own.items()
    }
    everything = [run for each in (mine, *constrained.values()) for run in each]
    theirs_all = [run for each in (usual, *(of.usual for of in own.values())) for run in each]
    violations = search.step_time(chosen.values) | broken(everything, theirs_all, terms)
    usual_violations = search.step_time(search.usual) | broken(theirs_all, theirs_all, terms)
    for name, constraint in plan.constraints.items():
        of = own.get(name, RunSet(runs, usual))
        violations[name] = exceeded(constraint, constrained.get(name, mine), of.usual, name)
        usual_violations[name] = exceeded(constraint, of.usual, of.usual, name)
    return TuneVerdict(
        len(runs),
        _estimate(terms, ours, theirs, lambda row: 1.0 - row.value),
        _estimate(terms, ours, theirs, lambda row: row.error),
        _estimate(terms, ours, theirs, lambda row: row.effort),
        [
            TermFigure(
                term,
                float(term.of(theirs[k])),
                float(term.of(ours[k])),
                _estimate([replace(term, weight=1.0)], ours[k : k + 1], theirs[k : k + 1], lambda row: row.value),
            )
            for k, term in enumerate(terms)
        ],
        in_words(violations),
        in_words(usual_violations),
        _put_back(plan, search, chosen, terms, bar),
    )


def _estimate(
    terms: Sequence[ObjectiveTerm], mine: FloatArray, usual: FloatArray, figure: Callable[[ObjectiveScore], FloatArray]
) -> BootstrapEstimate:
    if not (np.isfinite(mine).all() and np.isfinite(usual).all()):
        return BootstrapEstimate(np.nan, np.nan, np.nan)
    return BootstrapEstimate.of_same_runs((mine, usual), lambda ours, theirs: figure(score(terms, ours, theirs)))


def _put_back(
    plan: TunePlan, search: ConfigurationSearch, chosen: TunePoint, terms: Sequence[ObjectiveTerm], bar: ProgressBar
) -> list[PutBack]:
    other = [key for key, value in chosen.values.items() if value != search.usual[key]]
    if not other or not plan.verdict.put_back:
        return []
    runs = search.verdict_runs(plan.verdict.put_back)
    points = [{}, chosen.values, *({**chosen.values, key: search.usual[key]} for key in other)]
    usual, mine, *back = (table_of(terms, one) for one in search.drive(points, runs, bar, "putting parameters back"))

    def rise(changed: FloatArray, of: Callable[[ObjectiveScore], FloatArray]) -> BootstrapEstimate:
        if not all(np.isfinite(table).all() for table in (usual, mine, changed)):
            return BootstrapEstimate(np.nan, np.nan, np.nan)

        def difference(first: FloatArray, ours: FloatArray, theirs: FloatArray) -> FloatArray:
            return of(score(terms, first, theirs)) - of(score(terms, ours, theirs))

        return BootstrapEstimate.of_same_runs((changed, mine, usual), difference)

    changes = [
        PutBack(
            key,
            chosen.values[key],
            search.usual[key],
            rise(table, lambda row: row.value),
            rise(table, lambda row: row.error),
            rise(table, lambda row: row.effort),
        )
        for key, table in zip(other, back, strict=True)
    ]
    return sorted(changes, key=lambda row: -row.rise.value)
