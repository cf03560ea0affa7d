"""From logs to a folder with a plant, its report and a picture, for the command line."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.runner import available_cores
from diffdrive_mpc.bench.table import rich_table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.log_data import OptionError
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.models.logs.record import counted
from diffdrive_mpc_extras.twin.free_run import FreeMotion
from diffdrive_mpc_extras.twin.from_log import FittedTwin, twin_of
from diffdrive_mpc_extras.twin.problem import Task, one_by_one
from diffdrive_mpc_extras.twin.report import (
    NUMBERS,
    PLANT,
    REPORT,
    draw_held_out,
    fit_table,
    numbers,
    parameter_table,
    plant_text,
    report_text,
)

FIGURES = "figures"
_PICTURE = "held_out.png"


def twin_into(logs: Sequence[Path], out: Path, *, jobs: int | None = None, **options: Any) -> FittedTwin:  # noqa: ANN401 - those of `twin_of`
    """Fit a plant, print what was found, write plant file, report, numbers and picture into `out`.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an option, a log or the folder cannot be used; nothing is written then.
    """
    count = jobs or available_cores()
    files = (NUMBERS, REPORT, PLANT)
    with staged(out, files=files, folders=(FIGURES,), owner="twin") as folder, ProgressBar("reading", 1) as bar:
        with Parallel(n_jobs=count) as pool:

            def together(tasks: Sequence[Task]) -> list[list[FreeMotion] | None]:
                return list(pool(delayed(_call)(task) for task in tasks))

            twin = _twin(
                logs,
                together=one_by_one if count == 1 else together,
                on_stage=bar.begin,
                on_drive=bar.advance,
                on_findings=_print_findings,
                **options,
            )
        bar.begin("drawing", 1)
        (folder / FIGURES).mkdir()
        draw_held_out(twin, folder / FIGURES / _PICTURE)
        (folder / PLANT).write_text(plant_text(twin, datetime.date.today()), encoding="utf-8")
        words = report_text(twin, {"Measured, twin and identified model on rows held out": f"{FIGURES}/{_PICTURE}"})
        (folder / REPORT).write_text(words, encoding="utf-8")
        (folder / NUMBERS).write_text(json.dumps(numbers(twin), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    _print(twin, out)
    return twin


def _call(task: Task) -> list[FreeMotion] | None:
    return task()


def _twin(logs: Sequence[Path], **options: Any) -> FittedTwin:  # noqa: ANN401 - those of `twin_of`
    try:
        return twin_of(logs, **options)
    except OptionError as error:
        raise ConfigError(f"--{error.option.replace('_', '-')}{error.rest}") from error


def _print_findings(findings: Sequence[Finding]) -> None:
    console = output_console()
    for line in counted(findings):
        console.print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)


def _print(twin: FittedTwin, out: Path) -> None:
    console = output_console()
    for table in (fit_table(twin), parameter_table(twin)):
        console.print(rich_table(table))
    for note in twin.notes:
        console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
    line = f"Next: diffdrive-mpc simulate --plant mujoco:{out / PLANT} --trajectory square"
    console.print(line, markup=False, highlight=False, soft_wrap=True)
