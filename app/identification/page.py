"""The page of `identify`: what was found, measured beside simulated, how it drives, and what to do about warnings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.identification.figures import FOLDER, UNITS, step_responses
from diffdrive_mpc.app.identification.trial_drives import TrialDrive, trial_doubts, trial_table
from diffdrive_mpc.bench.html_report.document import picture
from diffdrive_mpc.bench.html_report.numbers import from_zero, rounded
from diffdrive_mpc.bench.html_report.origin import origin
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    Configuration,
    KeyFigure,
    Page,
    Picture,
    Runs,
    Series,
    Shown,
    Toggle,
    View,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.report import IdentificationReport
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.table import Table
from diffdrive_mpc.models.velocity_model import CHANNELS

_FILES = {"config.yaml": "Configuration that was written", "model.yaml": "Model that was written"}
_POINTS, _RUN_POINTS = 1500, 300
_PICTURES = {"What residuals still hold": "residuals.png", "Poles": "poles.png"}


@cache
def remedies() -> dict[str, str]:
    """What to do about each kind of warning."""
    found: dict[str, str] = read_yaml(Path(__file__).with_name("remedies.yaml"))
    return found


def identification_page(
    found: Identification,
    folder: Path,
    drives: Sequence[TrialDrive] | None,
    seconds: float,
) -> Page:
    """The page of an identification whose files and figures are in `folder`.

    Parameters
    ----------
    found
        What was found.
    folder
        Where its files are.
    drives
        How its configuration drives; None where there is none, or it does not drive at all.
    seconds
        How long it took.
    """
    report, trials = found.report, drives or ()
    names, paths = (tuple(dict.fromkeys(getattr(one, of) for one in trials)) for of in ("plant", "path"))
    toggles = [Toggle("stand-in", names, names, styled=True), Toggle("path", paths, paths[:1])] if trials else []
    shown = Shown(
        summary=[*report.in_short(), *([found.refusal] if found.refusal else [])],
        key_figures=_key_figures(report, trials),
        toggles=toggles,
        views=[*_simulations(report), *_driven(trials), *_charts(report), *_pictures(folder)],
        warnings=_warnings(report, trials),
        configurations=Configuration.of_files(folder, _FILES),
    )
    tables: list[Table] = [report.scores[0], *([trial_table(trials)] if trials else []), *report.tables]
    logs = [("logs", ", ".join(report.data.logs))]
    return Page("diffdrive-mpc identify", report.name, shown, tables, origin(describe_run(seconds), logs))


def _key_figures(report: IdentificationReport, drives: Sequence[TrialDrive]) -> list[KeyFigure]:
    fit, low = report.fitted.validation.fit_percent, identification_settings().warn.low_fit
    model = report.fitted.identified.model
    made = []
    for i, channel in enumerate(CHANNELS):
        sound = "good" if fit[i] >= low else "bad"
        training = f"on data held out; training {number(float(report.fitted.train.fit_percent[i]), 1)} %"
        made.append(KeyFigure(f"FIT of {channel}", f"{number(float(fit[i]), 1)} %", training, sound))  # type: ignore[arg-type]
    for i, channel in enumerate(CHANNELS):
        late, lag = 1e3 * model.dead_time[i], 1e3 * (model.lag[i] - model.dead_time[i])
        made.append(
            KeyFigure(f"{channel} follows after", f"{late + lag:.0f} ms", f"dead time {late:.0f}, lag {lag:.0f} ms")
        )
    verdicts = [one.verdict for one in report.doubts] + [one.verdict for one in report.data.findings if one.verdict]
    matter = sum(verdict is not None and verdict.matters for verdict in verdicts)
    made.append(
        KeyFigure(
            "warnings", str(len(verdicts)), f"{matter or 'none'} of which matter for driving", "bad" if matter else ""
        )
    )
    if drives:
        worst = max(drives, key=lambda one: one.lateral_share)
        beside = f"of its turning circle beside the path, at most ({worst.path})"
        made.append(
            KeyFigure(
                "driving with it",
                f"{100 * worst.lateral_share:.1f} %",
                beside,
                "bad" if trial_doubts(drives) else "good",
            )
        )
    return made


def _driven(drives: Sequence[TrialDrive]) -> list[View]:
    """The trial drives as linked views."""
    if not drives:
        return []
    plants = list(dict.fromkeys(one.plant for one in drives))
    runs = [
        run_series(
            one.run,
            f"{one.path} on {one.plant}",
            points=_RUN_POINTS,
            labels={"stand-in": one.plant, "path": one.path},
            style=plants.index(one.plant),
            every_layer=False,
        )
        for one in drives
    ]
    note = "Trial drives with the configuration that was written, on paths scaled to the robot. Point at either view."
    return [Runs(runs, note)]


def _simulations(report: IdentificationReport) -> list[View]:
    return [_simulation(report, i) for i in range(len(CHANNELS))]


def _charts(report: IdentificationReport) -> list[View]:
    """Steps, orders and drift where there are any."""
    made: list[View] = []
    if report.fitted.predictor is None:
        made += [_steps(report, j) for j in range(len(CHANNELS))]
    if report.fitted.orders:
        rows = report.fitted.orders.rows
        series = [
            Series(
                f"{channel}, {kind}",
                list(range(1, len(rows) + 1)),
                [rounded(getattr(row, name)[i]) for row in rows],
                2 * i + k,
            )
            for i, channel in enumerate(CHANNELS)
            for k, (kind, name) in enumerate(
                {"training": "train_fit_percent", "validation": "validation_fit_percent"}.items()
            )
        ]
        made.append(
            Chart("Orders compared", Axis("order"), Axis("FIT [%]"), series, f"Chosen: {report.fitted.orders.order}.")
        )
    if report.poses.drift:
        drift = report.poses.drift
        x = [one.horizon for one in drift]
        series = [
            Series("RMSE", x, [rounded(one.position_rmse) for one in drift], 0),
            Series("mean", x, [rounded(one.position_mean) for one in drift], 1),
        ]
        made.append(
            Chart("Drift of the pose", Axis("time since the poses agreed [s]"), Axis("position error [m]"), series)
        )
    return made


def _simulation(report: IdentificationReport, i: int) -> Chart:
    """The longest stretch held out: command, measured and simulated of one channel."""
    data, fitted, channel = report.data, report.fitted, CHANNELS[i]
    longest = int(np.argmax([len(record.command) for record in data.validation]))
    record, simulated = data.validation[longest], fitted.simulated[longest]
    (experiment,) = twist_experiments([record], data.yaw)
    measured = np.where(experiment.counts[:, i], experiment.outputs[:, i], np.nan)
    every = slice(None, None, max(1, -(-len(record.time) // _POINTS)))
    since_begin, when = from_zero(record.time)
    time = [round(float(one), 3) for one in since_begin[every]]
    lines = {"command": record.command[:, i], "measured": measured, "simulated": simulated[:, i]}
    series = [
        Series(name, time, [rounded(one) for one in values[every]], style, "points" if name == "measured" else "line")
        for (name, values), style in zip(lines.items(), (6, 0, 1), strict=True)
    ]
    fit = number(float(fitted.validation.fit_percent[i]), 1)
    note = f"Longest stretch held out; simulated from the commands alone. FIT of all of them: {fit} %."
    title = f"{channel}: measured and simulated"
    return Chart(title, Axis(when), Axis(f"{channel} [{UNITS[channel]}]"), series, note, broad=True)


def _steps(report: IdentificationReport, j: int) -> Chart:
    """The response of both outputs to a unit step of one command."""
    command = CHANNELS[j]
    time, response = step_responses(report)
    x = [round(float(one), 4) for one in time]
    series = [
        Series(f"{channel} [{UNITS[channel]}]", x, [rounded(one) for one in response[j][:, i]], i, "line")
        for i, channel in enumerate(CHANNELS)
    ]
    title = f"Step of {command}_ref by 1 {UNITS[command]}"
    note = f"Dead time {1e3 * report.fitted.identified.model.dead_time[j]:.0f} ms."
    return Chart(title, Axis("time [s]"), Axis("response"), series, note)


def _pictures(folder: Path) -> list[View]:
    drawn = {title: folder / FOLDER / name for title, name in _PICTURES.items()}
    return [Picture(title, picture(path), broad=False) for title, path in drawn.items() if path.is_file()]


def _warnings(report: IdentificationReport, drives: Sequence[TrialDrive]) -> list[Warned]:
    """Of log, estimate and drives; those that matter for driving first."""
    findings = [one for one in report.data.findings if one.severity != "note"]
    told = [(one.verdict, str(one), one.kind) for one in findings]
    told += [(one.verdict, str(one), one.kind) for one in (*report.doubts, *trial_doubts(drives))]
    told.sort(key=lambda one: one[0] is None or not one[0].matters)
    return [Warned(_sentence(words), remedies()[kind]) for _, words, kind in told]


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:] + ("" if words.endswith(".") else ".")
