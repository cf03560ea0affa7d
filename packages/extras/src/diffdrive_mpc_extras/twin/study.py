"""`diffdrive-mpc twin` as a study: fit a plant to logs; plant file, report, numbers and figure."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.log_data import OptionError
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.models.logs.record import counted
from diffdrive_mpc_extras.twin.free_run import FreeMotion
from diffdrive_mpc_extras.twin.from_log import FittedTwin, twin_of
from diffdrive_mpc_extras.twin.problem import Task, one_by_one
from diffdrive_mpc_extras.twin.report import PLANT, draw_held_out, fit_table, numbers, parameter_table, plant_text


class TwinStudy(Study[None, FittedTwin]):
    """The fit of a plant to logs; `logs` and `options` as in `twin_of`."""

    name = "twin"
    title = "A plant fitted to a log"

    def __init__(self, logs: Sequence[Path], **options: Any) -> None:  # noqa: ANN401 - those of `twin_of`
        self._logs, self._options = logs, options

    def plan(self) -> None:
        """Return nothing: the logs are read by `run`."""

    def run(self, plan: None, jobs: int, bar: ProgressBar) -> FittedTwin:
        """Fit; raises ConfigError, ValueError or OSError if an option or a log cannot be used."""
        del plan
        bar.begin("reading", 1)
        with Parallel(n_jobs=jobs) as pool:

            def together(tasks: Sequence[Task]) -> list[list[FreeMotion] | None]:
                return list(pool(delayed(_call)(task) for task in tasks))

            try:
                return twin_of(
                    self._logs,
                    together=one_by_one if jobs == 1 else together,
                    on_stage=bar.begin,
                    on_drive=bar.advance,
                    on_findings=_print_findings,
                    **self._options,
                )
            except OptionError as error:
                raise ConfigError(f"--{error.option.replace('_', '-')}{error.rest}") from error

    def report(self, results: FittedTwin, seconds: float) -> Report:
        """Return scores, parameters, the plant file, and the figure of the rows held out."""
        del seconds
        untold = [parameter.name for parameter in results.fit.told if not parameter.told]
        left = f"The log does not tell {', '.join(untold)}: the plant keeps the prior there." if untold else ""
        return Report(
            counted=f"{results.fit.drives} drives of the plant",
            meta={"logs": list(results.data.logs), "robot": results.name, "model": results.model_name},
            content=numbers(results),
            facts=[
                f"{results.name}: fitted to {results.fit.seconds:.0f} s of {', '.join(results.data.logs)}, the parts "
                f"in which the commands change most. {left}",
                f"Next: `diffdrive-mpc simulate --plant mujoco:{PLANT} --trajectory square`.",
            ],
            notes=results.notes,
            tables=[fit_table(results), parameter_table(results)],
            figures={"held_out.png": partial(draw_held_out, results)},
            files={PLANT: plant_text(results, datetime.date.today())},
        )


def _call(task: Task) -> list[FreeMotion] | None:
    return task()


def _print_findings(findings: Sequence[Finding]) -> None:
    for line in counted(findings):
        output_console().print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)
