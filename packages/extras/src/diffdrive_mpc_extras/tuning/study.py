"""Study `diffdrive-mpc tune`: search, comparison on the report seeds, report and configuration file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    KeyFigure,
    PageContents,
    PageWarning,
    Series,
)
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.run_row import STATISTICS
from diffdrive_mpc.bench.runner import persistent_processes
from diffdrive_mpc.bench.study import Report, Study, carry_out
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.whole_file import check_not_read, whole_file
from diffdrive_mpc.mpc import ControllerConfig, load_config
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.mpc.config.rooms import plain_key
from diffdrive_mpc_extras.bootstrap import BootstrapEstimate
from diffdrive_mpc_extras.tuning.search import ConfigurationSearch, TunePoint, Values, best_of, failed_runs
from diffdrive_mpc_extras.tuning.tune_file import TunePlan, load_plan

CONFIG = "config.yaml"
_OTHER_FIGURES = ("lateral_max_m", "heading_rmse_rad", "iterations_mean", "fallbacks")


@dataclass(frozen=True)
class Comparison:
    """Runs of the start configuration and of the best point with the report seeds, in the same order.

    Attributes
    ----------
    start, best
        Tables of `sweep`.
    start_errors, best_errors
        (runs,) position RMSE including failed runs [m].
    """

    start: DataFrame
    best: DataFrame
    start_errors: FloatArray
    best_errors: FloatArray

    def change(self, runs: FloatArray | slice = slice(None)) -> BootstrapEstimate:
        """Return the relative change of the mean error over `runs` [-], from paired runs."""
        pairs = np.array([self.best_errors[runs], self.start_errors[runs]])
        return BootstrapEstimate.of_same_runs(
            [pairs], lambda table: table.mean(axis=-1)[0] / table.mean(axis=-1)[1] - 1
        )

    @property
    def failures(self) -> tuple[int, int]:
        """Numbers of failed runs of the start configuration and of the best point."""
        return int(failed_runs(self.start).sum()), int(failed_runs(self.best).sum())

    @property
    def is_better(self) -> bool:
        """True if the 95 % interval of the change is below zero and no more runs fail."""
        start_failures, best_failures = self.failures
        return self.change().high < 0.0 and best_failures <= start_failures


@dataclass(frozen=True)
class TuningOutcome:
    """Points of the search, and the comparison of the best point with the start configuration."""

    points: list[TunePoint]
    best: TunePoint
    start: Values
    comparison: Comparison

    @property
    def changes(self) -> Values:
        """Values of the best point that differ from the start configuration."""
        return {key: value for key, value in self.best.values.items() if value != self.start[key]}

    @property
    def written(self) -> Values:
        """Changes in the written configuration file; empty if the best point is not better."""
        return self.changes if self.comparison.is_better else {}

    @property
    def sentence(self) -> str:
        """Result in one line."""
        if not self.changes:
            return "no better than the start configuration: no point has a smaller error on the tuning seeds"
        comparison, change = self.comparison, self.comparison.change()
        verdict = "better" if comparison.is_better else "no better"
        start_failures, best_failures = comparison.failures
        return (
            f"{verdict} than the start configuration: position RMSE {1e3 * comparison.best_errors.mean():.3g} mm "
            f"instead of {1e3 * comparison.start_errors.mean():.3g} mm on {len(comparison.best)} runs of the report "
            f"seeds ({_percent(change.value)}, 95 % interval {_percent(change.low)} to {_percent(change.high)}), "
            f"{best_failures} failed runs instead of {start_failures}"
        )


@dataclass(frozen=True)
class TuneResult:
    """Result of `tune`.

    Attributes
    ----------
    config_path
        Configuration file: the best point, or the start configuration if the point is not better.
    is_better
        True if the best point is better on the report seeds.
    sentence
        Result in one line.
    """

    config_path: Path
    is_better: bool
    sentence: str


class TuneStudy(Study[ConfigurationSearch, TuningOutcome]):
    """Search for a better configuration, and comparison with the start configuration.

    Parameters
    ----------
    config
        Start configuration: a shipped name or a file.
    plan
        Ranges, runs and seeds.
    """

    name, title = "tune", "Tuning"

    def __init__(self, config: str, plan: TunePlan) -> None:
        self._config, self._plan = config, plan

    def plan(self) -> ConfigurationSearch:
        """Prepare the search; raises the errors of `ConfigurationSearch`."""
        search = ConfigurationSearch(self._config, self._plan)
        if search.skipped:
            keys = ", ".join(search.skipped)
            output_console().print(f"note: not tuned, because the value has two sides: {keys}", soft_wrap=True)
        return search

    def run(self, plan: ConfigurationSearch, jobs: int, bar: ProgressBar) -> TuningOutcome:
        """Search with the tuning seeds, then compare with the report seeds."""
        seeds = self._plan.report_seeds.seeds
        with persistent_processes():
            points = plan.run(jobs, bar)
            best = best_of(points)
            bar.start_stage("comparing", 2 * self._plan.combinations * len(seeds))
            start_rows = plan.drive(plan.start, seeds, jobs, bar)
            best_rows = plan.drive(best.values, seeds, jobs, bar) if best.values != plan.start else start_rows
        comparison = Comparison(start_rows, best_rows, plan.errors(start_rows), plan.errors(best_rows))
        return TuningOutcome(points, best, plan.start, comparison)

    def report(self, results: TuningOutcome, seconds: float) -> Report:  # noqa: ARG002 - the page states it
        """Return tables, charts and the page."""
        plan, sentence, better = self._plan, results.sentence, results.comparison.is_better
        change = results.comparison.change()
        advice = f"{CONFIG} contains the start configuration; use more points (--points) or other ranges (--plan)"
        return Report(
            size=f"{len(results.points)} points",
            meta={"statistics": STATISTICS, "tuning": plan.description, "sentence": sentence, "is_better": better},
            content={
                "change": plain(change),
                "failures": results.comparison.failures,
                "best": results.best.number,
                "points": plain(results.points),
            },
            facts=[
                f"{Path(self._config).name}: {plan.description}.",
                f"{sentence[0].upper()}{sentence[1:]}.",
                f"{plan.points} points, each with {plan.combinations * plan.tuning_seeds.count} runs (tuning seeds).",
            ],
            notes=[
                f"Errors: {STATISTICS}.",
                f"The error of a failed run is at least {plan.failure_error:g} m. The search considers position errors "
                "only: compare step times and commands with `bench` before you use the configuration.",
            ],
            tables=[_comparison_table(results.comparison), _parameter_table(results)],
            figures={"search.png": [_search_chart(results.points)]},
            shown=PageContents(
                key_figures=[
                    KeyFigure("better", "yes" if better else "no", "on the report seeds", "good" if better else ""),
                    KeyFigure(
                        "position RMSE", _percent(change.value), f"{_percent(change.low)} to {_percent(change.high)}"
                    ),
                ],
                warnings=[] if better else [PageWarning(f"The best point is {sentence}.", advice)],
                configurations=[
                    ConfigurationView("Written configuration (YAML)", self._yaml(results, Path())),
                ],
            ),
        )

    def write(self, outcome: TuningOutcome, path: Path) -> None:
        """Write the configuration; paths in it become relative to its folder."""
        head = f"# Tuned from {Path(self._config).name}: {outcome.sentence}.\n"
        with whole_file(path) as draft:
            draft.write_text(head + self._yaml(outcome, path.parent), encoding="utf-8")

    def _yaml(self, outcome: TuningOutcome, folder: Path) -> str:
        notes = {plain_key(key): f"was {outcome.start[key]:g}" for key in outcome.written}
        return commented_yaml(_with_relative_paths(load_config(self._config, outcome.written), folder), notes)


def tune(
    config: str | Path,
    out: str | Path,
    *,
    plan: TunePlan | str | Path | None = None,
    plant: str | Path | None = None,
    points: int | None = None,
    jobs: int | None = None,
) -> TuneResult:
    """Tune a configuration, print the tables, and write config.yaml and the report into `out`.

    Parameters
    ----------
    config
        Start configuration: a file, or the name of a model with a shipped configuration.
    out
        Folder of the results.
    plan
        Plan or its file; by default the shipped one.
    plant
        Plant that replaces the plant of the plan: "mujoco:NAME", "model:NAME", or the file of a robot or twin.
    points
        Number of points that replaces the number in the plan.
    jobs
        Number of processes; by default one for each core. The result does not depend on it.

    Raises ConfigError or ValueError if a file is invalid, MissingPackageError without Optuna, StudyFailedError if a
    process died.
    """
    tune_plan = plan if isinstance(plan, TunePlan) else load_plan(None if plan is None else Path(plan))
    values = tune_plan.model_dump()
    if plant is not None:
        values["runs"]["plant"] = _plant_name(str(plant))
    if points is not None:
        values["points"] = points
    folder = Path(out)
    check_not_read(folder / CONFIG, f"--out {folder / CONFIG}")
    study = TuneStudy(str(config), check(TunePlan, values, "plan"))
    outcome = carry_out(study, folder, jobs)
    study.write(outcome, folder / CONFIG)
    return TuneResult(folder / CONFIG, outcome.comparison.is_better, outcome.sentence)


def _plant_name(name: str) -> str:
    is_file = ":" not in name and Path(name).suffix in (".yaml", ".yml")
    return f"mujoco:{Path(name).resolve()}" if is_file else name


def _with_relative_paths(config: ControllerConfig, folder: Path) -> ControllerConfig:
    def relative_path(file: str) -> str:
        return os.path.relpath(file, folder) if Path(file).is_file() else file

    terms = [term.model_copy(update={"file": relative_path(term.file)}) for term in config.terms]
    return config.model_copy(update={"model": relative_path(config.model), "terms": terms})


def _comparison_table(comparison: Comparison) -> Table:
    names = comparison.start["trajectory"].astype(str)
    groups = {name: (names == name).to_numpy() for name in dict.fromkeys(names)}
    rows = []
    for name, runs in (groups | {"all": np.ones(len(names), dtype=bool)}).items():
        start, best, change = comparison.start_errors[runs], comparison.best_errors[runs], comparison.change(runs)
        failures = [str(int(failed_runs(table[runs]).sum())) for table in (comparison.start, comparison.best)]
        cells = (number(1e3 * start.mean(), 3), number(1e3 * best.mean(), 3), _percent(change.value))
        rows.append((name, *cells, f"{_percent(change.low)} to {_percent(change.high)}", *failures))
    means = [
        f"{column} {comparison.start[column].mean():.3g} -> {comparison.best[column].mean():.3g}"
        for column in _OTHER_FIGURES
    ]
    columns = ("path", "start [mm]", "best [mm]", "change", "95 % interval", "failed, start", "failed, best")
    note = "Position RMSE of paired runs with bootstrap intervals. Means of other figures, start -> best: "
    return Table("Comparison on the report seeds", columns, tuple(rows), 1, f"{note}{'; '.join(means)}.")


def _parameter_table(outcome: TuningOutcome) -> Table:
    rows = tuple((key, f"{outcome.start[key]:g}", f"{value:g}") for key, value in outcome.best.values.items())
    note = "" if outcome.comparison.is_better else f"The best point is not written: {CONFIG} contains the start values."
    return Table("Best point of the search", ("parameter", "start", "best"), rows, 1, note)


def _search_chart(points: list[TunePoint]) -> Chart:
    numbers = [float(point.number) for point in points]
    errors = [1e3 * point.error for point in points]
    best = np.minimum.accumulate(errors).tolist()
    series = [Series("points", numbers, errors, 1, "points"), Series("best so far", numbers, best, 0, "line")]
    return Chart("Search on the tuning seeds", Axis("point"), Axis("mean position RMSE [mm]", "log"), series)


def _percent(change: float) -> str:
    return f"{100 * change:+.1f} %"
