"""The search: Optuna asks for points, a campaign drives them, fidelity by fidelity; what promises little is pruned.

Everything that is asked and told is kept in a storage, so an interrupted search goes on, and several machines may work
on one study. With one worker a seed fixes the study bit for bit, on however many processes its runs are driven: points
are asked for in groups of a fixed size, each with random numbers of its own, and are told in order.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

from diffdrive_mpc.app.tune.objective import (
    broken,
    check_usual,
    exceeded,
    in_words,
    predicted_p99,
    score,
    sizes_of,
    table_of,
    terms_of,
)
from diffdrive_mpc.app.tune.optuna_study import (
    STARTUP,
    distribution,
    near,
    needs_optuna,
    open_study,
    sampler,
    values_of,
)
from diffdrive_mpc.app.tune.tune_file import TunePlan, TuneRuns
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.rooms import plain_key
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, CampaignRun, drive_all
from diffdrive_mpc_extras.campaign.identity import key_of

# The points that a search tried: which can be used, which none beats, and how much each parameter matters.


Values = dict[str, Value]
"""Of the parameters, by key of the configuration."""
_TOP, _LEAST_TOP = 0.1, 5


@dataclass(frozen=True)
class TunePoint:
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

    points: list[TunePoint]
    importance: dict[str, float]

    @property
    def best(self) -> TunePoint:
        """The usable point with the least objective; the defaults where there is none."""
        return min(self.usable, key=lambda row: (row.value, row.number), default=self.points[0])

    @property
    def usable(self) -> list[TunePoint]:
        """Points that can be used."""
        return [point for point in self.points if point.usable]

    @property
    def front(self) -> list[TunePoint]:
        """Usable points that no other is better than in error and effort, the least error first."""
        ordered = sorted(self.usable, key=lambda row: (row.error, row.effort, row.number))
        return [point for k, point in enumerate(ordered) if all(point.effort < other.effort for other in ordered[:k])]


def importance_of(points: Sequence[TunePoint], distributions: Mapping[str, object]) -> dict[str, float]:
    """How much each parameter decides whether a point is among the best tenth with the first fidelity; adds up to 1.

    PED-ANOVA (Watanabe, Bansal, Hutter, IJCAI 2023). Empty where there are too few points.
    """
    known = [point for point in points if math.isfinite(point.first)]
    if len(known) < 2 * _LEAST_TOP:
        return {}
    optuna = needs_optuna()
    study = optuna.create_study()
    study.add_trials(
        [
            optuna.trial.create_trial(params=point.values, distributions=dict(distributions), value=point.first)
            for point in known
        ]
    )
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=max(_TOP, _LEAST_TOP / len(known)))
    importance = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(value) for name, value in sorted(importance.items(), key=lambda row: -row[1])}


_WORKER, _GROUP, _SCORE = "worker", "group", "score"


@dataclass(frozen=True)
class RunSet:
    """Runs that points are judged by, and what the defaults did on them."""

    runs: list[Definition]
    usual: list[CampaignRun] = field(default_factory=list)


@dataclass
class Judged:
    """A point under way: what came of it so far."""

    trial: Any
    values: Values
    violations: dict[str, float] = field(default_factory=dict)
    scores: list[tuple[float, float, float]] = field(default_factory=list)
    pruned: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether it is worth more runs."""
        return not self.pruned and not in_words(self.violations)


class ConfigurationSearch:
    """The search for a configuration.

    Parameters
    ----------
    plan
        What is searched, and on which runs.
    told
        The factors that name the controller.
    place
        Where runs are driven and kept.
    storage
        Address of a data base for Optuna, "mysql://..."; empty for a file in the folder of `place`.
    worker
        Number of this worker among those of one study, from 1.

    Raises ConfigError if a range or a factor has a mistake.
    """

    def __init__(
        self, plan: TunePlan, factors: Mapping[str, Value], place: CampaignPlace, storage: str = "", worker: int = 1
    ) -> None:
        self._plan, self._factors, self._place, self._storage, self._worker = plan, factors, place, storage, worker
        self._terms = terms_of(plan.objective)
        config = load_config(str(factors.get("config", factors["model"])))
        self.usual: Values = {key: _value(config, key) for key in plan.parameters}
        self._distributions = {
            key: distribution(key, parameter, self.usual[key]) for key, parameter in plan.parameters.items()
        }
        for end in ("low", "high"):
            load_config(
                str(factors.get("config", factors["model"])),
                {key: getattr(distribution, end) for key, distribution in self._distributions.items()},
            )
        self._fidelities = [
            RunSet(self._runs(plan.tuning, fidelity.runs, fidelity.factors)) for fidelity in plan.fidelities
        ]
        self._own = self.constraint_sets(plan.tuning)
        self._study: Any = None

    def verdict_runs(self, count: int) -> list[Definition]:
        """So many runs of the verdict."""
        return self._runs(self._plan.verdict, count, {})

    def constraint_sets(self, of: TuneRuns) -> dict[str, RunSet]:
        """The runs of each constraint that has its own, not driven yet."""
        listed = {name: constraint for name, constraint in self._plan.constraints.items() if constraint.runs}
        return {
            name: RunSet(self._runs(of, constraint.runs, constraint.factors)) for name, constraint in listed.items()
        }

    def run(self, bar: ProgressBar) -> Searched:
        """Ask, drive and tell until the study has its points.

        Raises ConfigError if the storage cannot be used or the objective has no value, MissingPackageError without
        Optuna, StudyFailedError if runs could not be driven.
        """
        self._fidelities = [self.with_usual(fidelity, bar) for fidelity in self._fidelities]
        self._own = {name: self.with_usual(run_set, bar) for name, run_set in self._own.items()}
        for fidelity in self._fidelities:
            check_usual(self._terms, table_of(self._terms, fidelity.usual))
        study = self._study = open_study(self._name(), self._place.folder, self._storage, self._plan.keep)
        while batch := self._next(study):
            self._judge(study, batch, bar)
        points = [self._point(trial) for trial in study.get_trials(deepcopy=False) if _SCORE in trial.user_attrs]
        return Searched(points, importance_of(points, self._distributions))

    def with_usual(self, of: RunSet, bar: ProgressBar) -> RunSet:
        """The same runs, driven with the defaults."""
        return RunSet(of.runs, self.drive([{}], of.runs, bar, "driving the defaults")[0])

    def drive(
        self, points: Sequence[Mapping[str, Value]], runs: Sequence[Definition], bar: ProgressBar, text: str
    ) -> list[list[CampaignRun]]:
        """Drive `runs` with the values of each point; what differs from the defaults is replaced in them."""
        candidates = []
        for values in points:
            other = {f"config.{key}": value for key, value in values.items() if value != self.usual[key]}
            candidates.append([run.changed(other) if other else run for run in runs])
        driven = drive_all([run for mine in candidates for run in mine], self._place, bar, text)
        by_run = {run.definition: run for run in driven}
        return [[by_run[run] for run in mine] for mine in candidates]

    def step_time(self, values: Mapping[str, Value]) -> dict[str, float]:
        """By which share of its limit the step time of a point is beyond it; empty without a limit."""
        stated, study = self._plan.step_time, self._study
        if stated is None:
            return {}
        # Kept in the storage: a measurement is another one each time.
        other = {key: value for key, value in sizes_of(values).items() if value != self.usual[key]}
        key = f"p99 [s] with {json.dumps(other, sort_keys=True)}"
        if key not in study.user_attrs:
            case = self._fidelities[0].runs[0].case
            study.set_user_attr(key, predicted_p99(stated, case, other))
        return {"step_time": study.user_attrs[key] / stated.at_most - 1.0}

    def _runs(self, of: TuneRuns, count: int, factors: Mapping[str, object]) -> list[Definition]:
        return self._plan.runs(of, count, self._factors, factors)

    def _name(self) -> str:
        """Of the study: another one for every plan, configuration, plant and version of the product."""
        sets = [*self._fidelities, *self._own.values()]
        plan = self._plan.model_dump(mode="json", exclude={"factors", "description", "verdict", "points"})
        text = json.dumps([plan, self.usual, [key_of(run) for run_set in sets for run in run_set.runs]], sort_keys=True)
        return f"tune {hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def _next(self, study: Any) -> list[Any]:  # noqa: ANN401 - has no types
        """The points to judge now: what is left of a group that was interrupted, or a new one; none in the end."""
        trials = study.get_trials(deepcopy=False)
        mine = [trial for trial in trials if trial.user_attrs.get(_WORKER) == self._worker]
        left = [trial for trial in mine if not trial.state.is_finished()]
        if not trials:
            study.enqueue_trial(dict(self.usual))
        size = 1 if not trials else min(self._plan.at_once, self._plan.points - len(trials))
        group = left[0].user_attrs[_GROUP] if left else [len(mine), size]
        begun = sum(trial.user_attrs[_GROUP] == group for trial in mine)
        batch = [needs_optuna().trial.Trial(study, trial._trial_id) for trial in left]
        for k in range(group[1] - begun):
            seeds = (self._plan.search_seed, self._worker, len(mine) + k)
            study.sampler = sampler(*seeds)
            if 0 < len(trials) + k < STARTUP:
                study.enqueue_trial(near(self._distributions, self.usual, *seeds))
            trial = study.ask(dict(self._distributions))
            trial.set_user_attr(_GROUP, group)
            trial.set_user_attr(_WORKER, self._worker)
            batch.append(trial)
        return batch

    def _judge(self, study: Any, batch: Sequence[Any], bar: ProgressBar) -> None:  # noqa: ANN401
        """Drive points fidelity by fidelity, prune, and tell in the end."""
        judged = [Judged(trial, self._values(trial.params)) for trial in batch]
        for candidate in judged:
            candidate.violations |= self.step_time(candidate.values)
        for k, of in enumerate(self._fidelities):
            left = [point for point in judged if point.goes_on]
            text = f"points {batch[0].number} to {batch[-1].number} of {self._plan.points}, fidelity {k + 1}"
            results = self.drive([candidate.values for candidate in left], of.runs, bar, text)
            for candidate, driven in zip(left, results, strict=True):
                self._take(candidate, k, driven, of.usual)
        left = [point for point in judged if point.goes_on]
        for name, of in self._own.items():
            results = self.drive([candidate.values for candidate in left], of.runs, bar, f"constraint {name}")
            for candidate, driven in zip(left, results, strict=True):
                candidate.violations |= broken(driven, of.usual, self._terms)
                candidate.violations[name] = exceeded(self._plan.constraints[name], driven, of.usual, name)
            left = [candidate for candidate in left if candidate.goes_on]
        state = needs_optuna().trial.TrialState
        for point in judged:
            for name, value in point.violations.items():
                point.trial.set_constraint(name, value)
            point.trial.set_user_attr(_SCORE, {"scores": point.scores, "broken": in_words(point.violations)})
        for point in judged:
            usable = point.goes_on
            study.tell(
                point.trial.number,
                point.scores[-1][0] if usable else None,
                state=state.COMPLETE if usable else state.PRUNED,
                skip_if_finished=True,
            )

    def _take(
        self, judged_point: Judged, fidelity: int, driven: Sequence[CampaignRun], usual: Sequence[CampaignRun]
    ) -> None:
        """Take what came of a point with one fidelity, and decide whether it goes on."""
        judged_point.violations |= broken(driven, usual, self._terms)
        for name, constraint in self._plan.constraints.items():
            if not constraint.runs:
                judged_point.violations[name] = exceeded(constraint, driven, usual, name)
        if judged_point.violations["not_driven"] > 0.0:
            return
        scored = score(self._terms, table_of(self._terms, driven), table_of(self._terms, usual))
        judged_point.scores.append((float(scored.value), float(scored.error), float(scored.effort)))
        if in_words(judged_point.violations) or fidelity == len(self._fidelities) - 1:
            return
        choice = f"pruned after fidelity {fidelity + 1}"
        if choice not in judged_point.trial.user_attrs:
            # Successive halving counts a resource, which grows by its factor.
            judged_point.trial.report(judged_point.scores[-1][0], self._plan.keep**fidelity)
            judged_point.trial.set_user_attr(choice, judged_point.trial.should_prune())
        # The defaults are what everything else is held against.
        judged_point.pruned = judged_point.trial.user_attrs[choice] and judged_point.trial.number > 0

    def _values(self, params: Mapping[str, Value]) -> Values:
        return values_of(params, self.usual)

    def _point(self, trial: Any) -> TunePoint:  # noqa: ANN401
        attributes = trial.user_attrs[_SCORE]
        values = self._values(trial.params)
        usable = trial.state == needs_optuna().trial.TrialState.COMPLETE
        if not attributes["scores"]:
            return TunePoint(trial.number, values, broken=attributes["broken"])
        value, error, effort = attributes["scores"][-1]
        first = attributes["scores"][0][0]
        return TunePoint(
            trial.number,
            values,
            len(attributes["scores"]),
            value,
            error,
            effort,
            first,
            attributes["broken"],
            usable=usable,
        )


def _value(config: object, key: str) -> Any:  # noqa: ANN401 - whatever the configuration holds
    try:
        return reduce(getattr, plain_key(key).split("."), config)
    except AttributeError as error:
        raise ConfigError(f"parameters.{key}: the configuration has no such key; see `config schema`") from error
