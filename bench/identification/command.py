"""From logs to a folder with everything that was found."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from pathlib import Path

from diffdrive_mpc.bench.atomic import staged
from diffdrive_mpc.bench.identification.configuration import MODEL_FILE, configuration
from diffdrive_mpc.bench.identification.data import read_data
from diffdrive_mpc.bench.identification.fitting import fit
from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.bench.identification.poses import from_poses
from diffdrive_mpc.bench.identification.report import write_json, write_markdown
from diffdrive_mpc.bench.identification.tables import drift_table, score_table
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.identification.model_file import model_file, write_model_file
from diffdrive_mpc.models.identification.ssm import LARGEST_ORDER
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_config

STRUCTURES = ("mbm", "sm", "ssm")
AUTOMATIC = "auto"
CONFIG_FILE = "config.yaml"
REPORT_FILES = (MODEL_FILE, CONFIG_FILE, "report.json", "report.md")
FIGURES = "figures"


def identify(
    logs: Sequence[Path],
    structure: str,
    *,
    validate: Sequence[Path],
    mapping: str | None,
    fit_share: float | None,
    order: str,
    effects: bool,
    name: str | None,
    out: Path,
) -> None:
    """Identify a model, print how good it is, and write the folder; parameters as the command's options.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError, OSError
        If an option, a log or the folder cannot be used, or the logs allow no model; nothing is written then.
    """
    wanted = _order(structure, order)
    if validate and fit_share is not None:
        raise ConfigError("--fit-share: with --validate all of the other logs is identified from; give one of them")
    if effects and structure != "sm":
        raise ConfigError(f"--effects: they stand around an sm, not an {structure}; give --model sm")
    if name is not None and not name.strip():
        raise ConfigError("--name: it is empty; give the model a name, or leave the option out")
    more = f" and {len(logs) - 1} more" if len(logs) > 1 else ""
    title = name or f"{structure.upper()} from {logs[0].stem}{more}"
    with staged(out, files=REPORT_FILES, folders=(FIGURES,)) as folder, ProgressBar("reading", 1) as bar:
        data = read_data(
            logs,
            validate,
            mapping=mapping,
            fit_share=DEFAULT_SHARE if fit_share is None else fit_share,
            wheels=structure == "mbm",
            on_findings=_print_findings,
        )
        check(ControllerConfig, {"sample_time": data.train[0].dt}, data.logs[0])
        bar.begin("identification (seconds, for an SSM up to minutes)", 1)
        fitted = fit(
            data,
            structure,
            wanted,
            effects=effects,
            on_trial=lambda effect: bar.begin(f"does the base show {effect}?", 1),
        )
        outcome = Outcome(title, data, fitted, from_poses(data, fitted))
        _write(outcome, folder, bar)
    _print(outcome, out)


DEFAULT_SHARE = 0.6
"""Part of a log to identify from where nothing else was asked."""


def _order(structure: str, order: str) -> int | None:
    if structure not in STRUCTURES:
        raise ConfigError(f"--model '{structure}': give one of {', '.join(STRUCTURES)}")
    if order == AUTOMATIC:
        return None
    if structure != "ssm":
        raise ConfigError(f"--order {order}: only ssm has a choice of order; leave it out for {structure}")
    if not (order.isdecimal() and 1 <= int(order) <= LARGEST_ORDER):
        raise ConfigError(f"--order '{order}': give {AUTOMATIC}, or 1 to {LARGEST_ORDER}")
    return int(order)


def _write(outcome: Outcome, folder: Path, bar: ProgressBar) -> None:
    from diffdrive_mpc.bench.figures.identification.draw import draw_identification, figures_of  # noqa: PLC0415 - matplotlib is slow

    day = date.today()
    content = model_file(
        outcome.fitted.identified,
        name=outcome.name,
        source=", ".join(outcome.data.logs),
        records=[record.name for record in outcome.data.train],
        date=day,
        train_fit_percent=outcome.fitted.train.fit_percent,
        validation_fit_percent=outcome.fitted.validation.fit_percent,
        notes=f"validated on {outcome.data.held_out}",
    )
    write_model_file(folder / MODEL_FILE, content)
    (folder / CONFIG_FILE).write_text(configuration(outcome), encoding="utf-8")
    Controller(load_config(folder / CONFIG_FILE))  # what is written can be driven with
    figures = folder / FIGURES
    figures.mkdir()
    bar.begin("figures", len(figures_of(outcome)))
    names = draw_identification(outcome, figures, bar.advance)
    write_json(outcome, folder / "report.json")
    write_markdown(outcome, names, day, folder / "report.md")


def _print_findings(findings: Sequence[Finding]) -> None:
    console = output_console()
    for finding in findings:
        console.print(f"{finding.severity}: {finding}", markup=False, highlight=False, soft_wrap=True)


def _print(outcome: Outcome, out: Path) -> None:
    console = output_console()
    console.print(score_table(outcome).rich())
    if outcome.poses.drift:
        console.print(drift_table(outcome).rich())
    said = {str(finding) for finding in outcome.data.findings}
    for warning in outcome.warnings:
        if warning not in said:
            console.print(f"warning: {warning}", markup=False, highlight=False, soft_wrap=True)
    chosen = outcome.fitted.orders
    if chosen:
        console.print(f"order {chosen.order}: {chosen.reason}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"estimated in {outcome.fitted.seconds:.1f} s; written to {out}", markup=False, highlight=False)
