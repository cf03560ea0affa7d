"""From logs to a folder with everything that was found, for the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.studies.identification.figures import FOLDER, draw_identification, figures_of
from diffdrive_mpc.bench.studies.identification.trial_drives import PATHS, trial_drives, trial_table, trial_warnings
from diffdrive_mpc.bench.table import rich_table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification import Identification, identify
from diffdrive_mpc.models.identification.from_logs import CONFIG_FILE, FILES
from diffdrive_mpc.models.identification.log_data import OptionError
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.mpc import load_config


def identify_into(logs: Sequence[Path], out: Path, **options: Any) -> None:  # noqa: ANN401 - those of `identify`
    """Identify a model, print how good it is, and write files and figures into `out`.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an option, a log or the folder cannot be used, or the logs allow no model; nothing is written then.
    """
    with staged(out, files=FILES, folders=(FOLDER,)) as folder, ProgressBar("reading", 1) as bar:
        try:
            found = identify(logs, on_findings=_print_findings, on_progress=lambda text: bar.begin(text, 1), **options)
        except OptionError as error:
            raise ConfigError(f"--{error.option.replace('_', '-')}{error.rest}") from error
        bar.begin("figures", len(figures_of(found.report)))
        found.write(folder, draw_identification(found.report, folder, bar.advance))
        bar.begin("driving", 2 * len(PATHS))
        drives = trial_drives(found, load_config(folder / CONFIG_FILE), bar.advance)
        with (folder / "report.md").open("a", encoding="utf-8") as report:
            report.write("\n" + trial_table(drives).markdown())
    _print(found, out)
    output_console().print(rich_table(trial_table(drives)))
    for warning in trial_warnings(drives):
        _print_line(f"warning: {warning}")


def _print_findings(findings: Sequence[Finding]) -> None:
    for finding in findings:
        _print_line(f"{finding.severity}: {finding}")


def _print(found: Identification, out: Path) -> None:
    report = found.report
    for table in report.scores:
        output_console().print(rich_table(table))
    said = {str(finding) for finding in report.data.findings}
    for warning in report.warnings:
        if warning not in said:
            _print_line(f"warning: {warning}")
    chosen = report.fitted.orders
    if chosen:
        _print_line(f"order {chosen.order}: {chosen.reason}")
    _print_line(f"estimated in {report.fitted.seconds:.1f} s; written to {out}")


def _print_line(text: str) -> None:
    output_console().print(text, markup=False, highlight=False, soft_wrap=True)
