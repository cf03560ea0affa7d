"""The tuning of a controller as a study: search, verdict, report and the configuration that comes of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from diffdrive_mpc.app.tune.optuna_study import needs_optuna
from diffdrive_mpc.app.tune.report import configuration, facts, front_chart, search_chart, shown, tables
from diffdrive_mpc.app.tune.search import ConfigurationSearch, Searched
from diffdrive_mpc.app.tune.tune_file import TunePlan, load_plan
from diffdrive_mpc.app.tune.verdict import TuneVerdict, judge
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import STATISTICS
from diffdrive_mpc.bench.runner import lasting_processes
from diffdrive_mpc.bench.study import Report, Study, carry_out
from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.whole_file import check_not_read
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignPlace
from diffdrive_mpc_extras.proof.study import told_of

CONFIG = "config.yaml"


@dataclass(frozen=True)
class TuningOutcome:
    """What a tuning found: the points, the verdict on the best of them, and the values that the defaults have."""

    searched: Searched
    verdict: TuneVerdict
    usual: Mapping[str, Value]


@dataclass(frozen=True)
class TuneResult:
    """What `tune` leaves.

    Attributes
    ----------
    config_path
        The configuration that was written: the chosen point, or the defaults where it is no better.
    improved
        Whether it is better on runs of other seeds.
    sentence
        What came of it, in one line, with the interval.
    tuned
        All of it.
    """

    config_path: Path
    improved: bool
    sentence: str
    tuned: TuningOutcome


class TuneStudy(Study[ConfigurationSearch, TuningOutcome]):
    """Search for a configuration, and the verdict on what was found.

    Parameters
    ----------
    config
        The controller's configuration: a file, or the shipped one of a model.
    plan
        What is searched, and on which runs.
    place
        Where runs are driven and kept.
    storage, worker
        Those of `tune.search.ConfigurationSearch`.
    """

    name, title, shared = "tune", "Tuning", True

    def __init__(self, config: str, plan: TunePlan, place: CampaignPlace, storage: str = "", worker: int = 1) -> None:
        self._config, self._plan, self._place = config, plan, place
        self._storage, self._worker = storage, worker

    def plan(self) -> ConfigurationSearch:
        """Make the search; raises ConfigError where a range or a factor has a mistake."""
        needs_optuna()
        return ConfigurationSearch(self._plan, told_of(self._config), self._place, self._storage, self._worker)

    def cases(self, plan: ConfigurationSearch) -> Iterable[Case]:
        """A run of the verdict."""
        return [plan.verdict_runs(1)[0].case]

    def run(self, plan: ConfigurationSearch, jobs: int, bar: ProgressBar) -> TuningOutcome:  # noqa: ARG002 - the place has them
        """Search, then judge the best point."""
        # Many short lists of runs: processes that start anew for each would cost as much as the runs.
        with lasting_processes():
            searched = plan.run(bar)
            return TuningOutcome(searched, judge(self._plan, plan, searched.best, bar), plan.usual)

    def report(self, results: TuningOutcome, seconds: float) -> Report:  # noqa: ARG002 - its tables say it
        """Tables, the front, and how the search went."""
        searched, verdict = results.searched, results.verdict
        front = {"front.png": [front_chart(searched)]} if self._plan.objective.effort else {}
        return Report(
            counted=f"{len(searched.points)} points",
            meta={
                "statistics": STATISTICS,
                "controller": Path(self._config).name,
                "tuning": self._plan.description,
                "sentence": verdict.sentence,
                "improved": verdict.improved,
            },
            content={
                "verdict": plain(replace(verdict, put_back=[], figures=[])),
                "put_back": plain(verdict.put_back),
                "figures": plain(verdict.figures),
                "importance": searched.importance,
                "chosen": searched.best.number,
                "front": [one.number for one in searched.front],
                "points": plain(searched.points),
            },
            facts=[f"{Path(self._config).name}: {self._plan.description}.", *facts(self._plan, searched, verdict)],
            notes=[f"Errors: {STATISTICS}."],
            tables=tables(searched, verdict, results.usual),
            figures=front | {"search.png": [search_chart(searched)]},
            shown=shown(self._config, searched, verdict, results.usual),
        )


def tune(
    config: str | Path,
    out: str | Path,
    *,
    plan: TunePlan | str | Path | None = None,
    plant: str | Path | None = None,
    points: int | None = None,
    workers: int | None = None,
    scheduler: str = "",
    storage: str = "",
    worker: int = 1,
) -> TuneResult:
    """Tune a controller, print the tables, and write config.yaml, the report and the study into `out`.

    Parameters
    ----------
    config
        Configuration to start from: a file, or the shipped one of a model.
    out
        Folder of the results, of the study and of the rows of its runs; what is there already is not driven again.
    plan
        What is searched and on which runs: a plan or its file; by default the shipped one.
    plant
        Plant in place of the plan's: "mujoco:NAME", "model:NAME", or the file of a robot or twin.
    points
        How many are tried, in place of what the plan says; with more of them a study goes on.
    workers
        Processes that drive runs; by default one for each core.
    scheduler
        Address of a Dask scheduler that drives them instead.
    storage
        Address of a data base for the study; by default a file in `out`.
    worker
        Number of this worker, where several work on one study.

    Raises ConfigError or ValueError if a file has a mistake, MissingPackageError without Optuna, StudyFailedError if
    runs could not be driven.
    """
    read = plan if isinstance(plan, TunePlan) else load_plan(None if plan is None else Path(plan))
    if plant is not None:
        read = read.model_copy(update={"factors": read.factors | {"plant": _plant(plant)}})
    if points is not None:
        read = check(TunePlan, read.model_dump() | {"points": points}, "--points")
    folder = Path(out)
    check_not_read(folder / CONFIG, f"--out {folder / CONFIG}")
    study = TuneStudy(str(config), read, CampaignPlace(folder, workers, scheduler), storage, worker)
    tuned = carry_out(study, folder, workers)
    path = folder / CONFIG
    configuration(str(config), tuned.searched, tuned.verdict, read, tuned.usual, path)
    return TuneResult(path, tuned.verdict.improved, tuned.verdict.sentence, tuned)


def _plant(plant: str | Path) -> str:
    """A plant as a case names it: the file of a robot is one of the physics."""
    named = str(plant)
    alone = ":" not in named and Path(named).suffix in (".yaml", ".yml")
    return f"mujoco:{Path(named).resolve()}" if alone else named
