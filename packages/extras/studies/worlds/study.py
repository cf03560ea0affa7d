"""The study of narrow places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pandas import DataFrame
from studies.worlds.results import measured, study_tables
from studies.worlds.settings import WorldsSettings, cases

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases
from diffdrive_mpc.bench.experiment import ExperimentRun, by, drive_all, json_rows, total
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError

Plan = list[tuple[str, Case]]
"""Part of the study and what to run."""


class WorldsStudy(Study[Plan, DataFrame]):
    """Every controller in the same worlds.

    Parameters
    ----------
    settings
        What the parts are.
    parts
        Which of them.
    controllers, model
        Who drives, and the model of the predictive controller.
    runs
        How many runs of each part, by its name, of doorway and named at most; those of the settings where it has none.
    first
        The first seed.
    """

    name = "worlds"
    title = "Narrow places"

    def __init__(
        self,
        settings: WorldsSettings,
        parts: Sequence[str],
        *,
        controllers: Sequence[str],
        model: str,
        runs: Mapping[str, int] | None = None,
        first: int = 0,
    ) -> None:
        self._settings, self._parts, self._controllers = settings, parts, controllers
        self._model, self._runs, self._first = model, runs or {}, first

    def plan(self) -> Plan:
        """The cases; raises ConfigError or ValueError if one of them cannot be run."""
        unknown = [name for name in self._controllers if name not in CONTROLLERS]
        if unknown:
            raise ConfigError(f"--controllers: unknown controller '{unknown[0]}'; known: {', '.join(CONTROLLERS)}")
        plan = [
            (part, case)
            for part in self._parts
            for case in cases(self._settings, part, self._controllers, self._model, self._runs.get(part), self._first)
        ]
        check_cases({(case.controller, case.plant, case.surface): case for _, case in reversed(plan)}.values())
        return plan

    def run(self, plan: Plan, jobs: int, bar: ProgressBar) -> DataFrame:
        """Run every case; each process keeps only what the study needs."""
        bar.begin(f"running, {jobs} at a time", len(plan))
        return drive_all([ExperimentRun(case, {"part": part}) for part, case in plan], jobs, bar.advance, measured)

    def report(self, results: DataFrame, seconds: float) -> Report:
        """Return the tables."""
        parts = ", ".join(f"{len(rows)} of “{name}”" for name, rows in by(results, "part").items())
        drivers = by(results, "driver")
        touched = total(results, "collided")
        return Report(
            counted=f"{len(results)} runs",
            meta={"first_seed": self._first, "settings": self._settings.model_dump()},
            content={"runs": json_rows(results)},
            facts=[
                f"{len(results)} runs in {seconds} s: {parts}, by {', '.join(drivers)}, from seed {self._first} on.",
                f"In {touched} of them MuJoCo found a contact of the robot's hull while the robot moved.",
            ],
            tables=study_tables(results),
        )
