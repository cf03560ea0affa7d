"""The study of narrow places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases
from diffdrive_mpc.bench.outcomes import group
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.worlds.results import Rows, collided, run_world, said, study_tables
from studies.worlds.settings import WorldsSettings, cases

Plan = list[tuple[str, Case]]
"""Part of the study and what to run."""


class WorldsStudy(Study[Plan, Rows]):
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
        one_of_each = group([case for _, case in plan], lambda case: (case.controller, case.plant, case.surface))
        check_cases(runs[0] for runs in one_of_each.values())
        return plan

    def run(self, plan: Plan, jobs: int, bar: ProgressBar) -> Rows:
        """Run every case; each process keeps only what the study needs."""
        bar.begin(f"running, {jobs} at a time", len(plan))
        return run_tasks([partial(run_world, part, case) for part, case in plan], jobs, bar.advance)

    def report(self, results: Rows, seconds: float) -> Report:
        """Tables and figures."""
        from studies.worlds.figures import drawings  # noqa: PLC0415 - matplotlib loads slowly

        touched = sum(map(collided, results))
        parts = ", ".join(f"{len(runs)} of “{name}”" for name, runs in group(results, lambda one: one.part).items())
        drivers = list(group(results, lambda one: one.driver))
        words = [
            f"{driver} did not arrive and said: {message}." for driver in drivers for message in said(results, driver)
        ]
        return Report(
            counted=f"{len(results)} runs",
            meta={"first_seed": self._first, "settings": self._settings.model_dump()},
            content={"runs": [one.as_json() for one in results]},
            facts=[
                f"{len(results)} runs in {seconds} s: {parts}, by {', '.join(drivers)}, from seed {self._first} on.",
                f"In {touched} of them MuJoCo found a contact of the robot's hull while the robot moved.",
            ],
            notes=words,
            tables=study_tables(results),
            figures=drawings(results),
        )
