"""Run an experiment for the command line: plan, run, time, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.case import NO_SCENARIO, Case
from diffdrive_mpc.bench.commands.options import parse_seeds, split_names, split_numbers
from diffdrive_mpc.bench.console import output_console
from diffdrive_mpc.bench.controllers import PEERS, default_model
from diffdrive_mpc.bench.experiment import CasePlan, Experiment, default_experiment, plan_cases
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.results import Results, describe
from diffdrive_mpc.bench.runner import Outcome, available_cores, run_cases, time_outcomes
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.bench.tables import report_tables
from diffdrive_mpc.models.checked_yaml import ConfigError

_NAME_LISTS = {
    "controllers": "--controller",
    "models": "--models",
    "trajectories": "--trajectories",
    "plants": "--plant",
    "surfaces": "--surface",
    "sensors": "--sensors",
    "scenarios": "--scenario",
}
"""Dimensions that are lists of names, and their options."""


@dataclass(frozen=True)
class Choices:
    """The options of the command as they were typed; None where one was not given."""

    controllers: str | None = None
    models: str | None = None
    trajectories: str | None = None
    seeds: str | None = None
    plants: str | None = None
    surfaces: str | None = None
    sensors: str | None = None
    horizons: str | None = None
    config: Path | None = None
    settings: Sequence[str] = ()
    quick: bool = False
    scenarios: str | None = None

    def experiment(self) -> Experiment:
        """The experiment that these options ask for; raises ConfigError or ValueError when one cannot be used."""
        default, only_peers = default_experiment(), self._only_peers()
        changes: dict[str, object] = {"settings": tuple(sweep_settings(self.settings))}
        for name, option in _NAME_LISTS.items():
            text = getattr(self, name)
            if text is not None:
                changes[name] = split_names(text, option)
        if self.config is not None:
            changes["config"] = str(self.config)
            changes.setdefault("models", (default_model(self.config),))
        if self.seeds is not None:
            changes["seeds"] = parse_seeds(self.seeds)
        elif self.quick:
            changes["seeds"] = default.seeds[:1]
        changes["horizons"] = () if only_peers else self._horizons(default)
        return default.model_copy(update=changes)

    def _only_peers(self) -> bool:
        """Whether no controller has a model or a configuration; raises ConfigError if there are options for one."""
        chosen = default_experiment().controllers
        if self.controllers is not None:
            chosen = split_names(self.controllers, "--controller")
        if not set(chosen) <= set(PEERS):
            return False
        given = [self.models is not None, self.config is not None, bool(self.settings), self.horizons is not None]
        if any(given):
            raise ConfigError(f"the controller '{chosen[0]}' takes no --models, --config, --set or --horizons")
        return True

    def _horizons(self, default: Experiment) -> tuple[int, ...]:
        swept = any(setting.partition("=")[0].strip() == "horizon" for setting in self.settings)
        if self.horizons is None:
            return () if self.quick or self.settings or self.scenarios else default.horizons
        if self.horizons.strip().lower() == "none":
            return ()
        if swept:
            raise ConfigError("--horizons and --set horizon=...: give one of them")
        return split_numbers(self.horizons, "--horizons", least=1)


def compare(choices: Choices, out: Path, jobs: int | None = None) -> Results:
    """Run what `choices` ask for, print the tables and write the report into `out`.

    Parameters
    ----------
    jobs
        Processes for the parallel pass; by default one for each core.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an option cannot be used or `out` not be written to; then `out` keeps what it held.
    bench.errors.NotReproducibleError
        If the replay for the step times gave other commands.
    """
    from diffdrive_mpc.bench.figures.draw import count_figures  # noqa: PLC0415 - matplotlib loads slowly, and bad input needs none
    from diffdrive_mpc.bench.report import FIGURES, REPORT_FILES, write_report  # noqa: PLC0415

    began = time.perf_counter()
    experiment = choices.experiment()
    plan = plan_cases(experiment)
    with staged(out, files=REPORT_FILES, folders=(FIGURES,)) as folder, ProgressBar("preparing") as bar:
        outcomes, cpu_share = _run(plan, jobs or available_cores(), bar)
        results = Results(
            experiment,
            tuple(outcomes[case] for case in plan.main),
            tuple(outcomes[case] for case in plan.horizon),
            describe(experiment, time.perf_counter() - began, cpu_share),
        )
        bar.begin("drawing figures", count_figures(results))
        write_report(results, folder, bar.advance)
    console = output_console()
    for table in report_tables(results):
        console.print(table.rich())
    console.print(f"{len(plan.all)} runs in {time.perf_counter() - began:.0f} s; report in {out}", highlight=False)
    return results


def incomplete(results: Results) -> str | None:
    """One line about the runs of the predictive controller that did not complete; None where all did."""
    ours = [outcome for outcome in results.all if outcome.case.controller not in PEERS]
    failed = [outcome for outcome in ours if not outcome.run.metrics.completed]
    if not failed:
        return None
    case, ended = failed[0].case, failed[0].run.ended
    labels = case.labels
    first = f"{labels['model']} on {labels['trajectory']}, horizon {case.horizon}, seed {case.seed}"
    first += f", scenario {labels['scenario']}" if case.scenario != NO_SCENARIO else ""
    first += f" ({ended})" if ended else ""
    return f"{len(failed)} of {len(ours)} runs of mpc did not complete, the first: {first}; bench.json lists them"


def _run(plan: CasePlan, jobs: int, bar: ProgressBar) -> tuple[dict[Case, Outcome], float]:
    bar.begin(f"running, {jobs} at a time", len(plan.all))
    recorded = run_cases(plan.all, jobs, bar.advance)
    bar.begin("timing, one at a time", len(recorded))
    timed, cpu_share = time_outcomes(recorded, bar.advance)
    return {outcome.case: outcome for outcome in timed}, cpu_share
