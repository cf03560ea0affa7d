"""How cases went: put together by what they share, the figures over them that tables and figures show, and rows."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from pydantic import BaseModel

from diffdrive_mpc.bench.case import DIMENSIONS, Case
from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.runner import OnDone, run_tasks
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.mpc import Trajectory
from diffdrive_mpc.sim import Metrics, Run
from diffdrive_mpc.sim.metrics.recovery import Recovery
from diffdrive_mpc.sim.run import NO_SOLVER

_BY_THE_CLOCK = ("step_time", "solve_time", "deadline")
STATISTICS = "true pose against the reference, from t = 0 to the end of the reference, no settling time added"


@dataclass(frozen=True)
class SolverShares:
    """Which way the solver took, in shares of the solved ticks [%], and at how many ticks nothing was solved.

    Unlimited: no limit was active. Active set: the limits that were guessed were proven. Backend: OSQP or DAQP solved
    it. NaN where nothing was solved.
    """

    path_unlimited_percent: float
    path_active_set_percent: float
    path_backend_percent: float
    not_solved: int

    @classmethod
    def of(cls, run: Run) -> SolverShares:
        """Over the ticks of `run` that the statistics cover."""
        paths = Counter(path for path, counted in zip(run.solver_paths, run.counted, strict=True) if counted)
        solved = paths.total() - paths[NO_SOLVER]

        def share(*ways: str) -> float:
            return 100.0 * sum(paths[way] for way in ways) / solved if solved else math.nan

        return cls(share("unlimited"), share("active_set"), share("osqp", "daqp"), paths[NO_SOLVER])


class Scored(Protocol):
    """A case and the statistics of its run."""

    @property
    def case(self) -> Case:
        """What was run."""
        ...

    @property
    def metrics(self) -> Metrics:
        """Its statistics."""
        ...

    @property
    def recovery(self) -> Recovery:
        """How it came back after a disturbance."""
        ...

    @property
    def shares(self) -> SolverShares:
        """Which way its solver took."""
        ...


S = TypeVar("S", bound=Scored)
T = TypeVar("T")
K = TypeVar("K")


@dataclass(frozen=True)
class Outcome:
    """A case and all of its run; satisfies `Scored`.

    Where it was timed, `clean_share` is the share of its ticks that could be measured undisturbed; the times of the
    others are NaN, unless those of all controllers were kept, see `bench.timing.time_outcomes`.
    """

    case: Case
    run: Run
    clean_share: float = 1.0

    @classmethod
    def of(cls, case: Case) -> Outcome:
        """Run a case, and work out its errors where there are several processes to do it."""
        run = run_case(case)
        _ = run.errors
        return cls(case, run)

    @property
    def metrics(self) -> Metrics:
        """Statistics of the run."""
        return self.run.metrics

    @property
    def recovery(self) -> Recovery:
        """How it came back after a disturbance."""
        return self.run.recovery

    @property
    def shares(self) -> SolverShares:
        """Which way its solver took."""
        return SolverShares.of(self.run)


def run_cases(
    cases: Sequence[Case], jobs: int, on_done: OnDone, scored: Sequence[Case] = ()
) -> tuple[list[Outcome], list[Score]]:
    """Run cases, see `bench.runner.run_tasks`, and others of which only the statistics are wanted."""
    tasks: list[Callable[[], Outcome | Score]] = [partial(Outcome.of, case) for case in cases]
    tasks += [partial(Score.of, case) for case in scored]
    found = run_tasks(tasks, jobs, on_done)
    return [one for one in found if isinstance(one, Outcome)], [one for one in found if isinstance(one, Score)]


@dataclass(frozen=True)
class Score:
    """A case and what is left of its run where only its statistics are wanted; satisfies `Scored`."""

    case: Case
    metrics: Metrics
    recovery: Recovery
    shares: SolverShares

    @classmethod
    def of(cls, case: Case) -> Score:
        """Run it."""
        return cls.of_outcome(Outcome(case, run_case(case)))

    @classmethod
    def of_outcome(cls, outcome: Outcome) -> Score:
        """What is kept of one that was run."""
        return cls(outcome.case, outcome.metrics, outcome.recovery, outcome.shares)


def mean(outcomes: Iterable[Scored], metric: str) -> float:
    """Mean of one metric over runs; NaN without runs, and where one of them could not compute it."""
    values = [getattr(outcome.metrics, metric) for outcome in outcomes]
    return float(np.mean(values)) if values else math.nan


def worst(outcomes: Iterable[Scored], metric: str) -> float:
    """Largest value of one metric over runs."""
    return float(np.max([getattr(outcome.metrics, metric) for outcome in outcomes]))


def count(outcomes: Iterable[Scored], metric: str) -> int:
    """Sum over runs of one metric that counts, or that is true or not."""
    return sum(getattr(outcome.metrics, metric) for outcome in outcomes)


def recoveries(outcomes: Iterable[Scored], figure: str) -> FloatArray:
    """(runs,) one figure of the recovery from the disturbance."""
    return np.array([getattr(outcome.recovery, figure) for outcome in outcomes])


def step_times(outcomes: Iterable[Outcome]) -> FloatArray:
    """Times of the whole step [s] at the counted ticks of several runs that have one."""
    return _times([outcome.run.step_time[outcome.run.counted] for outcome in outcomes])


def solve_times(outcomes: Iterable[Outcome]) -> FloatArray:
    """The same of linearising, condensing and solving."""
    return _times([outcome.run.solve_time[outcome.run.counted] for outcome in outcomes])


def _times(parts: list[FloatArray]) -> FloatArray:
    times = np.concatenate(parts)
    return times[np.isfinite(times)]


def time_percentile(times: FloatArray, percent: float) -> float:
    """A percentile of times; NaN without any."""
    return float(np.percentile(times, percent)) if times.size else math.nan


def disturbed_share(outcomes: Iterable[Outcome]) -> float:
    """Share of the ticks of several runs that could not be timed undisturbed."""
    runs = list(outcomes)
    return float(np.average([1.0 - one.clean_share for one in runs], weights=[len(one.run.time) for one in runs]))


def drawn_distances(outcomes: Iterable[Outcome]) -> FloatArray:
    """Distance of the reference from the path as it was drawn [m], at all counted ticks of several runs."""
    found = [np.zeros(0)]
    for run in (outcome.run for outcome in outcomes):
        times, of = run.time[run.counted], run.reference
        found.append(of.drawn_distance(times) if isinstance(of, Trajectory) else np.zeros(times.size))
    return np.concatenate(found)


def group(outcomes: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Outcomes by a key, in the order of first appearance."""
    grouped: dict[K, list[T]] = {}
    for outcome in outcomes:
        grouped.setdefault(key(outcome), []).append(outcome)
    return grouped


def by(dimension: str, outcomes: Iterable[S]) -> dict[str, list[S]]:
    """Outcomes by the label of a dimension, in the order of first appearance."""
    return group(outcomes, lambda outcome: outcome.case.labels[dimension])


def by_model(outcomes: Iterable[S]) -> dict[str, list[S]]:
    """Outcomes by the name of their model as tables write it."""
    return group(outcomes, lambda outcome: model_name(outcome.case.labels["model"]))


def by_horizon(outcomes: Iterable[S]) -> dict[int, list[S]]:
    """Outcomes of predictive controllers by horizon, shortest first."""
    grouped = group(outcomes, lambda outcome: outcome.case.horizon)
    return dict(sorted((steps, group) for steps, group in grouped.items() if steps is not None))


def nested(outcomes: Iterable[S], *dimensions: str) -> list[tuple[tuple[str, ...], list[S]]]:
    """Groups by several dimensions, the first varying most slowly, each with the names that tables give it."""
    if not dimensions:
        return [((), list(outcomes))]
    first, *rest = dimensions
    return [
        ((model_name(name) if first == "model" else name, *names), runs)
        for name, part in by(first, outcomes).items()
        for names, runs in nested(part, *rest)
    ]


def with_mean(grouped: Mapping[str, list[S]]) -> list[tuple[str, list[S]]]:
    """Groups, and where there are several, below them everything under "mean"."""
    parts = list(grouped.items())
    return [*parts, ("mean", [one for part in grouped.values() for one in part])] if len(parts) > 1 else parts


def by_driver(outcomes: Sequence[S]) -> dict[str, list[S]]:
    """Outcomes by what is compared: controller and model, and place and settings where they vary.

    The names of a dimension that does not vary are left out, and so is "mpc" beside the name of its model.
    """
    varying = [one for one in DIMENSIONS if one.place and len(by(one.name, outcomes)) > 1]
    several = len({outcome.case.overrides for outcome in outcomes if outcome.case.controller == "mpc"}) > 1

    def driver(outcome: S) -> str:
        labels = outcome.case.labels
        parts = [who_drives(outcome.case)]
        parts += [labels[one.name] if one.kind is str else f"{one.name}={labels[one.name]}" for one in varying]
        parts += [f"{key}={value}" for key, value in outcome.case.overrides] if several else []
        return ", ".join(parts)

    return group(outcomes, driver)


def who_drives(case: Case) -> str:
    """Model of the predictive controller, or name of a peer."""
    labels = case.labels
    return model_name(labels["model"]) if labels["controller"] == "mpc" else labels["controller"]


def model_name(name: str) -> str:
    """Name of a model as the papers write it, or that of the user's file."""
    if name in STRUCTURES:
        return name.upper()
    return {one.name: one.title for one in function_structures().values()}.get(name, name)


def metrics_row(outcome: Scored, *, timed: bool = True) -> dict[str, object]:
    """Statistics of one run and the ways of its solver, for JSON; without what the clock says if it was not `timed`."""
    values = asdict(outcome.metrics) | asdict(outcome.shares)
    return {name: value for name, value in values.items() if timed or not name.startswith(_BY_THE_CLOCK)}


def plain(value: object, digits: int | None = None) -> Any:  # noqa: ANN401 - whatever JSON takes
    """Dataclasses, settings, mappings, sequences and arrays as dicts, lists and numbers; what is not finite as None.

    Parameters
    ----------
    value
        What is to be written.
    digits
        Significant digits of every number that is not whole; None for all of them.
    """
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {of.name: getattr(value, of.name) for of in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(entry, digits) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(entry, digits) for entry in value]
    if isinstance(value, (float, np.floating)):
        number = float(value) if digits is None else float(f"{value:.{digits}g}")
        return number if math.isfinite(number) else None
    return value
