"""HTML page of `identify` with results, measurement and simulation, trial drives, and warnings with remedies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from diffdrive_mpc.app.identification.figures import FOLDER, other_charts, simulation_charts
from diffdrive_mpc.app.identification.trial_drives import TrialDrive, trial_doubts, trial_table
from diffdrive_mpc.app.identification.verdict import TrialVerdict, remedies
from diffdrive_mpc.bench.html_report.document import picture
from diffdrive_mpc.bench.html_report.origin import origin
from diffdrive_mpc.bench.html_report.page import (
    ConfigurationView,
    EmbeddedPicture,
    KeyFigure,
    Page,
    PageContents,
    PageWarning,
    RunViews,
    Toggle,
    View,
)
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.identification.deliver.report import IdentificationReport
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.table import TextTable
from diffdrive_mpc.models.velocity_model import CHANNELS

_FILES = {"config.yaml": "Written configuration", "model.yaml": "Written model"}
_POINTS, _RUN_POINTS = 1500, 300
_PICTURES = {"Correlation of residuals": "residuals.png", "Poles": "poles.png"}


def identification_page(verdict: TrialVerdict, folder: Path, seconds: float) -> Page:
    """Build the page of an identification whose files and figures are in `folder`.

    Parameters
    ----------
    verdict
        Verdict on the identification, with the trial drives of its configuration.
    folder
        Folder of the result files.
    seconds
        Duration of the identification [s].
    """
    report, trials = verdict.identification.report, verdict.drives
    plants, paths = (
        tuple(dict.fromkeys(getattr(trial, attribute) for trial in trials)) for attribute in ("plant", "path")
    )
    toggles = [Toggle("stand-in", plants, plants, styled=True), Toggle("path", paths, paths[:1])] if trials else []
    content = PageContents(
        summary=[*report.findings_summary, *verdict.headed_conclusions()],
        key_figures=_key_figures(report, trials),
        toggles=toggles,
        views=[*simulation_charts(report), *_drive_views(trials), *other_charts(report), *_pictures(folder)],
        warnings=_warnings(report, trials),
        configurations=ConfigurationView.of_files(folder, _FILES),
    )
    tables: list[TextTable] = [report.scores[0], *([trial_table(trials)] if trials else []), *report.tables]
    logs = [("logs", ", ".join(report.data.logs))]
    return Page("diffdrive-mpc identify", report.name, content, tables, origin(describe_run(seconds), logs))


def _key_figures(report: IdentificationReport, drives: Sequence[TrialDrive]) -> list[KeyFigure]:
    fit, min_fit = report.fitted.validation.fit_percent, identification_settings().warn.low_fit
    model = report.fitted.identified.model
    figures = []
    for i, channel in enumerate(CHANNELS):
        rating = "good" if fit[i] >= min_fit else "bad"
        training = f"on validation data; training {number(float(report.fitted.train.fit_percent[i]), 1)} %"
        figures.append(KeyFigure(f"FIT of {channel}", f"{number(float(fit[i]), 1)} %", training, rating))  # type: ignore[arg-type]
    for i, channel in enumerate(CHANNELS):
        dead_time, lag = 1e3 * model.dead_time[i], 1e3 * (model.lag[i] - model.dead_time[i])
        parts = f"dead time {dead_time:.0f}, lag {lag:.0f} ms"
        figures.append(KeyFigure(f"delay of {channel}", f"{dead_time + lag:.0f} ms", parts))
    all_verdicts = [item.verdict for item in report.objections]
    count = sum(verdict is not None and verdict.matters for verdict in all_verdicts)
    note = f"{count or 'none'} relevant for driving"
    figures.append(KeyFigure("warnings", str(len(all_verdicts)), note, "bad" if count else ""))
    if drives:
        worst = max(drives, key=lambda row: row.lateral_share)
        label = f"maximum lateral error over the circle's radius, on path {worst.path}"
        share = f"{100 * worst.lateral_share:.1f} %"
        figures.append(KeyFigure("trial drives", share, label, "bad" if trial_doubts(drives) else "good"))
    return figures


def _drive_views(drives: Sequence[TrialDrive]) -> list[View]:
    """Return linked views of the trial drives."""
    if not drives:
        return []
    plants = list(dict.fromkeys(drive.plant for drive in drives))
    runs = [
        run_series(
            drive.run,
            f"{drive.path} on {drive.plant}",
            points=_RUN_POINTS,
            labels={"stand-in": drive.plant, "path": drive.path},
            style=plants.index(drive.plant),
        )
        for drive in drives
    ]
    note = "Trial drives with the written configuration, on paths scaled to the robot. Both views are linked."
    return [RunViews(runs, note)]


def _pictures(folder: Path) -> list[View]:
    paths = {title: folder / FOLDER / name for title, name in _PICTURES.items()}
    return [EmbeddedPicture(title, picture(path), broad=False) for title, path in paths.items() if path.is_file()]


def _warnings(report: IdentificationReport, drives: Sequence[TrialDrive]) -> list[PageWarning]:
    """Return the warnings about log, estimate and drives; warnings that matter for driving come first."""
    items = [*report.objections, *trial_doubts(drives)]
    items.sort(key=lambda item: item.verdict is None or not item.verdict.matters)
    return [PageWarning(_sentence(str(item)), remedies()[item.kind]) for item in items]


def _sentence(text: str) -> str:
    first = text[:1] if text.partition(":")[0] in CHANNELS else text[:1].upper()
    return first + text[1:] + ("" if text.endswith(".") else ".")
