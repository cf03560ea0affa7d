"""Implementation of `identify`, which writes all results of an identification to a folder."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.app.identification.figures import FOLDER, draw_identification, figures_of
from diffdrive_mpc.app.identification.page import identification_page
from diffdrive_mpc.app.identification.trial_drives import FIRST_CIRCLE, first_circle, recipe, trial_doubts, trial_table
from diffdrive_mpc.app.identification.unexplained_motion import write_robot
from diffdrive_mpc.app.identification.verdict import TrialVerdict, judge_by_drives
from diffdrive_mpc.bench.html_report.document import write_page
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import REPORT, staged
from diffdrive_mpc.bench.table import rich_table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification import Identification, identify
from diffdrive_mpc.models.identification.advice import AdvisedError
from diffdrive_mpc.models.identification.deliver.configuration import CONFIG_FILE
from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.from_logs import FILES
from diffdrive_mpc.models.identification.log_data import LogData, OptionError
from diffdrive_mpc.models.logs import Finding, Log
from diffdrive_mpc.models.logs.diagnosis import summary
from diffdrive_mpc.models.logs.draft_mapping import draft_mapping
from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.models.logs.record import format_labelled_findings
from diffdrive_mpc.models.plug_ins import known_packages, plug_in, plug_in_names
from diffdrive_mpc.models.stated_robot import load_stated_robot
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.models.table import TextTable, plain_line
from diffdrive_mpc.sim.plants.identified_robot import ROBOT_FILE


class ParameterWriter(Protocol):
    """Plug-in of the group `diffdrive_mpc.parameter_writers` that writes the parameter file of one package.

    The estimate of the first writer is used for all writers of a call.
    """

    def estimate(self, data: LogData, limits: Mapping[str, float], base: IdentifiedBase | None) -> Any:  # noqa: ANN401
        """Estimate the parameters that a log determines."""

    def text(self, estimate: Any) -> str:  # noqa: ANN401 - result of `estimate`
        """Return the text of the parameter file."""

    def table(self, estimate: Any) -> TextTable:  # noqa: ANN401 - result of `estimate`
        """Return a table with a row for each quantity."""


def identify_into(
    logs: Sequence[Path],
    out: Path,
    *,
    packages: str | None = None,
    force: bool = False,
    **options: Any,  # noqa: ANN401 - options of `identify`
) -> None:
    """Identify a model, print summaries of the logs and of the model quality, and write files and figures to `out`.

    Parameter files of the packages in `packages`, a comma-separated list, are also written. Model and configuration are
    written if logs, FIT and trial drives are sufficient, or with `force`. A mapping that corrects the logs is always
    written.

    Raises
    ------
    models.errors.MissingPackageError
        If no installed plug-in writes the parameters of a package.
    models.checked_yaml.ConfigError, ValueError, OSError
        If an option, a log or the folder cannot be used, or if no model can be identified. No file is written then,
        except for a mapping that corrects the logs.
    """
    names = dict.fromkeys(name.strip() for name in packages.split(",")) if packages is not None else {}
    known = {*known_packages()["parameter_writers"], *plug_in_names("parameter_writers")} if names else set()
    if unknown := names.keys() - known:
        raise ConfigError(f"--for {format_unknown_name(min(unknown), sorted(known))}")
    writers = {name: plug_in("parameter_writers", name) for name in names}
    try:
        _identify_into(logs, out, writers, force, options)
    except AdvisedError as error:
        if error.advice is None:
            raise
        with staged(out, files=(error.advice.file,)) as folder:
            error.advice.write(folder)
        raise ConfigError(f"{error}. {error.advice.sentence(out)}") from error


def _identify_into(
    logs: Sequence[Path], out: Path, writers: Mapping[str, ParameterWriter], force: bool, options: Mapping[str, Any]
) -> None:
    # `staged` creates the folder `out`, which may have the name of a missing log.
    if missing := [log for log in logs if not log.exists()]:
        raise ConfigError(f"{missing[0]}: there is no such file or folder")
    start = time.perf_counter()
    files = (*FILES, FIRST_CIRCLE, ROBOT_FILE, *(f"{package}.yaml" for package in writers), REPORT)
    table = None
    folders = staged(out, files=files, folders=(FOLDER,), owner="identify")
    with folders as folder, ProgressBar("reading", 1, lines=True) as bar:
        verdict = _trial_verdict(_identify(logs, bar, force, options), bar, force)
        _write(verdict, folder, bar, force)
        if writers and (force or not verdict.identification.refusal):
            bar.start_stage("parameters of other packages", 1)
            report = verdict.identification.report
            estimator = next(iter(writers.values()))
            estimate = estimator.estimate(report.data, report.fitted.identified.limits, report.fitted.base)
            table = estimator.table(estimate)
            for package, writer in writers.items():
                (folder / f"{package}.yaml").write_text(writer.text(estimate), encoding="utf-8")
        write_page(identification_page(verdict, folder, time.perf_counter() - start), folder / REPORT)
    _print_identification(verdict.identification, out)
    if table:
        output_console().print(rich_table(table))
    if verdict.identification.advice:
        _print_line(verdict.identification.advice.sentence(out))
    _print_verdict(verdict, out, force)


def _identify(logs: Sequence[Path], bar: ProgressBar, force: bool, options: Mapping[str, Any]) -> Identification:
    """Identify a model from the logs; error messages name the options of the command line."""
    if (robot := options.get("robot")) is not None:
        stated = load_stated_robot(robot)
        for line in (f"{stated.name}, values stated by the manufacturer, not identified:", *stated.lines()):
            echo(line if line.endswith(":") else f"  {plain_line(line)}")
    try:
        return identify(
            logs,
            force=force,
            on_log=_print_log,
            on_findings=_print_findings,
            on_progress=lambda text: bar.start_stage(text, 1),
            **options,
        )
    except OptionError as error:
        raise ConfigError(f"--{error.option.replace('_', '-')}{error.rest}") from error


def _trial_verdict(identification: Identification, bar: ProgressBar, force: bool) -> TrialVerdict:
    """Run the trial drives of the configuration, unless the model is refused."""
    if identification.refusal and not force:
        return TrialVerdict(identification, None, (), failure=identification.refusal)
    return judge_by_drives(identification, bar.start_stage, bar.advance, force=force)


def _write(verdict: TrialVerdict, folder: Path, bar: ProgressBar, force: bool) -> None:
    """Write report and figures; also write model, configuration and first circle if the drives pass or with `force`."""
    identification = verdict.identification
    report = identification.report
    bar.start_stage("figures", len(figures_of(report)))
    figures = draw_identification(report, folder, bar.advance)
    is_usable = force or not verdict.failure
    if is_usable:
        identification.write_model(folder)
    if identification.advice:
        identification.advice.write(folder)
    head = ["```text", *verdict.lines(), "```", "", *(f"{line}\n" for line in report.findings_summary)]
    sections = [report.markdown(figures, head)]
    if verdict.drives:
        doubts = "".join(f"* {doubt}\n" for doubt in trial_doubts(verdict.drives))
        sections += [trial_table(verdict.drives).markdown(), doubts]
    if is_usable and verdict.config is not None:
        circle = first_circle(verdict.config, identification.model)
        (folder / FIRST_CIRCLE).write_text(circle.text(), encoding="utf-8")
        if verdict.robot is not None:
            write_robot(verdict.robot, folder / ROBOT_FILE)
        sections.append(recipe(circle, verdict.config, verdict.drives, report.data.topics))
    (folder / "report.md").write_text("\n".join(part for part in sections if part), encoding="utf-8")
    results = report.as_json() | {"verdict": verdict.as_json()}
    (folder / "report.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _print_verdict(verdict: TrialVerdict, out: Path, force: bool) -> None:
    """Print the results of the drives and the next steps; raise ConfigError if no configuration is written."""
    if verdict.drives:
        output_console().print(rich_table(trial_table(verdict.drives)))
    for doubt in trial_doubts(verdict.drives):
        _print_line(f"warning: {doubt}")
    if verdict.failure and force:
        _print_line(f"warning: written because of --force, but {verdict.failure}")
    echo("\n" + "\n".join(verdict.lines(out)))
    if verdict.failure and not force:
        note = f" ({out / CONFIG_FILE} is from an earlier run)" if (out / CONFIG_FILE).exists() else ""
        raise ConfigError(f"{verdict.failure}; no model and no configuration are written{note}, --force writes them")


def _print_log(log: Log) -> None:
    _print_line(log.name)
    echo("\n".join(f"  {line}" for line in summary(log)))


def _print_findings(findings: Sequence[Finding]) -> None:
    for line in format_labelled_findings(findings):
        _print_line(line)


def _print_identification(identification: Identification, out: Path) -> None:
    report = identification.report
    for table in report.scores:
        output_console().print(rich_table(table))
    for doubt in report.doubts:
        _print_line(f"warning: {doubt}")
    if report.fitted.orders:
        _print_line(f"order {report.fitted.orders.order}: {report.fitted.orders.reason}")
    _print_line(report.findings_summary[0])
    for setting in identification.configuration.bounds:
        _print_line(f"limit {setting.line()}")
    if identification.configuration.room:
        room = ", ".join(f"{setting.name} {setting.value:g} m" for setting in identification.configuration.room)
        _print_line(f"lengths above the defaults, because the robot is larger or faster: {room}")
    _print_line(f"estimated in {report.fitted.seconds:.1f} s; report: {out / 'report.md'}")


def _print_line(text: str) -> None:
    output_console().print(plain_line(text), markup=False, highlight=False, soft_wrap=True)


# Draft of a mapping file, and findings of reading the log with the draft.


_DEFAULT_NAME = "mapping.yaml"


def write_draft(logs: Sequence[Path], out: Path | None) -> None:
    """Draft the mapping of one log, read the log with it, and print the findings.

    Parameters
    ----------
    logs
        One CSV file or bag.
    out
        File with the suffix .yaml, or folder for mapping.yaml; None for the current folder.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are several logs, the log cannot be read, or the file exists or cannot be written.
    """
    if len(logs) != 1:
        raise ConfigError(f"--draft-mapping: {len(logs)} logs; pass one, and use its mapping for similar logs")
    target = Path(_DEFAULT_NAME) if out is None else out if out.suffix in (".yaml", ".yml") else out / _DEFAULT_NAME
    text = draft_mapping(logs[0])
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        place = target if target.exists() else target.parent
        raise ConfigError(f"{place}: the file exists and is not replaced; move it, or pass --out FILE.yaml") from error
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written ({error.strerror})") from error
    echo(f"{target}: draft with reasons; check and correct it\n")
    echo(text)
    try:
        findings = [str(finding) for finding in read_log(logs[0], target).findings]
    except ConfigError as error:
        findings = [str(error)]
    if findings:
        echo("\n  ".join(["Findings with this draft:", *findings]))
    command = shlex.join(["diffdrive-mpc", "identify", str(logs[0]), "--mapping", str(target)])
    echo(f"Next: correct {target}, then {command}")
