"""What the page of a replay shows beside the tables: the drive as linked views, differences, ages and innovations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.statistics import NAMES, Difference
from diffdrive_mpc.app.replay.verdicts import Diagnosis
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    KeyFigure,
    Mark,
    RunSeries,
    RunViews,
    Series,
    Shown,
    Toggle,
    Warned,
    from_zero,
)
from diffdrive_mpc.bench.html_report.run_series import run_series
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.record import BoolArray
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.run import NO_SOLVER

_UNITS = (("v", "m/s"), ("omega", "rad/s"))
_POINTS = 3000
"""Ticks of all runs of one who commands, at most."""
_CHART_POINTS = 1200
_LEAST_TICKS = 10
_HINT = (
    "Point at either view, or move the slider: the other shows the same time. The robot is drawn where the estimator "
    "believed it to be, and “true” means that, too: the log does not hold the truth. Errors are the drive's. Time "
    "counts from the start of a drive."
)


def replay_page(
    recording: Recording,
    replays: Mapping[str, Replayed],
    references: Sequence[Reference],
    counted: BoolArray,
    difference: Difference,
    verdicts: Sequence[Diagnosis],
) -> Shown:
    """Everything that the page shows beside tables and charts.

    Parameters
    ----------
    recording, references, counted
        The drive, what was tracked from each start on, and (n,) the ticks that count.
    replays
        By who commands; the first is the one that is compared with the drive by `found`.
    said
        What the log tells.
    """
    replayed = next(iter(replays.values()))
    runs, toggles = _runs(recording, replays, references, counted)
    return Shown(
        key_figures=_key_figures(difference, replayed, counted, verdicts),
        toggles=toggles,
        views=[RunViews(runs, _HINT)] if runs else [],
        warnings=[Warned(verdict.what, verdict.remedy) for verdict in verdicts],
        configurations=[_configuration(who, replay.config) for who, replay in replays.items()],
        pictures=not runs,
    )


def _key_figures(
    difference: Difference, replayed: Replayed, counted: BoolArray, verdicts: Sequence[Diagnosis]
) -> list[KeyFigure]:
    times = 1e3 * replayed.step_time[counted]
    p50, p99 = np.percentile(times, [50, 99])
    modes = [mode for mode, keep in zip(replayed.modes, counted, strict=True) if keep]
    safe = sum(mode not in ("TRACKING", "FINISHED") for mode in modes)
    return [
        KeyFigure("the same commands", "yes" if difference.same else "no", f"{difference.compared} ticks compared"),
        KeyFigure("largest difference of v", f"{difference.largest[0]:.3g} m/s", f"RMS {difference.rms[0]:.3g} m/s"),
        KeyFigure(
            "largest difference of omega", f"{difference.largest[1]:.3g} rad/s", f"RMS {difference.rms[1]:.3g} rad/s"
        ),
        KeyFigure("ticks without a fresh plan", str(safe), "", "bad" if safe else "good"),
        KeyFigure("step time, median", f"{number(float(p50), 2)} ms", f"p99 {number(float(p99), 2)} ms, of the replay"),
        KeyFigure("worth a look", str(len(verdicts)), "see below"),
    ]


def _configuration(who: str, config: ControllerConfig) -> ConfigurationView:
    model = config.model if is_shipped(config.model) else config.model.rsplit("/", 1)[-1]
    text = commented_yaml(config.model_copy(update={"model": model}))
    return ConfigurationView(f"Configuration, {who}, every value with its meaning (YAML)", text)


def _runs(
    recording: Recording, replays: Mapping[str, Replayed], references: Sequence[Reference], counted: BoolArray
) -> tuple[list[RunSeries], list[Toggle]]:
    """The drive with the recorded commands and with those of each replay, drive by drive; and buttons for them."""
    commands = {"recorded": recording.command} | {who: replay.command for who, replay in replays.items()}
    replayed = next(iter(replays.values()))
    begins = [number for number, tick in enumerate(recording.ticks) if tick.start is not None]
    runs: list[RunSeries] = []
    drives: list[str] = []
    spans = list(zip(pairwise([*begins, len(recording.ticks)]), references, strict=True))
    for place, ((first, stop), reference) in enumerate(spans, start=1):
        kept = np.flatnonzero(counted & (np.arange(len(counted)) >= first) & (np.arange(len(counted)) < stop))
        if len(kept) < _LEAST_TICKS or not np.isfinite(replayed.estimate[kept, 0]).any():
            continue
        drives.append(str(place))
        start = recording.ticks[first].start
        assert start is not None
        for style, (who, rows) in enumerate(commands.items()):
            of = replays.get(who, replayed)
            run = _run(recording, of, reference, start.t0, kept, rows, recorded=who not in replays)
            labels = {"controller": who, "drive": str(place), "path": str(place)}
            points, name = max(200, _POINTS // len(spans)), f"{who}, drive {place}"
            runs.append(run_series(run, name, points=points, labels=labels, style=style, config=of.config))
    toggles = [Toggle("controller", tuple(commands), tuple(commands), styled=True)]
    if len(drives) > 1:
        toggles.append(Toggle("drive", tuple(drives), tuple(drives[:1])))
    return runs, toggles if runs else []


def _run(
    recording: Recording,
    replayed: Replayed,
    reference: Reference,
    t0: float,
    kept: NDArray[np.intp],
    command: FloatArray,
    *,
    recorded: bool,
) -> Run:
    """A drive as a run whose truth is what the estimator believed."""
    ticks = [recording.ticks[k] for k in kept]
    time = recording.time[kept] - t0
    tracked = reference.sample(time)
    believed = _filled(replayed.estimate[kept])
    return Run(
        reference=reference,
        sample_time=replayed.config.sample_time,
        time=time,
        true_pose=believed[:, :3],
        true_twist=np.column_stack([believed[:, 3], np.zeros(len(kept)), believed[:, 4]]),
        reference_pose=tracked.pose,
        reference_twist=tracked.twist,
        reference_arc_length=tracked.arc_length,
        command=np.nan_to_num(command[kept]),
        step_time=np.full(len(kept), np.nan) if recorded else replayed.step_time[kept],
        modes=tuple(tick.mode for tick in ticks) if recorded else tuple(replayed.modes[k] for k in kept),
        messages=tuple(tick.message for tick in ticks) if recorded else tuple(replayed.messages[k] for k in kept),
        measurements=tuple(tick.measurement for tick in ticks),
        solver_methods=tuple(
            (tick.solver_path if recorded else replayed.solver_methods[k]) or NO_SOLVER
            for tick, k in zip(ticks, kept, strict=True)
        ),
        estimates=replayed.estimate[kept],
        estimate_deviations=replayed.deviation[kept],
    )


def _filled(rows: FloatArray) -> FloatArray:
    """Rows of which the ones that are not known are those before them, or the first known."""
    known = np.flatnonzero(np.isfinite(rows).all(axis=1))
    latest = np.clip(np.searchsorted(known, np.arange(len(rows)), side="right") - 1, 0, None)
    return np.asarray(rows[known[latest]])


def command_charts(
    recording: Recording, replayed: Replayed, other: FloatArray | None, counted: BoolArray
) -> list[Chart]:
    """Recorded and replayed commands over time, and by how much they differ; `other` are commands beside them."""
    time, title = from_zero(recording.time[counted])
    rows = {"recorded": recording.command, "replayed": replayed.command} | ({} if other is None else {"other": other})
    made = []
    for i, (name, unit) in enumerate(_UNITS):
        series = [
            Series(who, *_thinned(time, values[counted, i]), style=k, kind="line")
            for k, (who, values) in enumerate(rows.items())
        ]
        made.append(Chart(f"Command {name}", Axis(title), Axis(f"{name} [{unit}]"), series))
    apart = (replayed.command - recording.command)[counted]
    differences = [
        Series(f"{name} [{unit}]", *_thinned(time, apart[:, i]), style=i, kind="line")
        for i, (name, unit) in enumerate(_UNITS)
    ]
    note = "What this controller would have commanded otherwise, while it believed that the recorded one went out."
    return [*made, Chart("Replayed less recorded command", Axis(title), Axis("difference"), differences, note)]


def trust_charts(recording: Recording, replayed: Replayed, counted: BoolArray) -> list[Chart]:
    """Age of what each tick got, and how it fits to what was predicted."""
    begin = recording.time[counted][0]
    time, title = from_zero(recording.time[counted])
    when = Axis(title)
    ages = [
        Series(name, *_thinned(came - begin, age), style=i, kind="line")
        for i, (field, name) in enumerate(NAMES.items())
        for came, age in [_ages(recording, field, counted)]
    ]
    fits = [
        Series(name, *_thinned(time, replayed.innovations[counted, column]), style=i, kind="points")
        for i, (column, name) in enumerate(((3, "poses"), (0, "wheels, v"), (1, "wheels, omega"), (2, "gyro")))
    ]
    return [
        Chart(
            "Age of readings at the tick that got them",
            when,
            Axis("age [ms]"),
            [age for age in ages if len(age.x)],
            "From the stamp. What steps, comes late; where nothing is drawn, nothing came.",
        ),
        Chart(
            "How readings fit to what was predicted",
            when,
            Axis("squared innovation over its variance [-]", "log"),
            [fit for fit in fits if len(fit.x)],
            "1 on average where the estimator's assumptions hold. Lasting values far above tell of a wrong model, dead "
            "time or stamp.",
            marks=[Mark(1.0, "as assumed")],
        ),
    ]


def _ages(recording: Recording, field: str, counted: BoolArray) -> tuple[FloatArray, FloatArray]:
    came = np.array(
        [
            (tick.time, 1e3 * (tick.time - getattr(tick.measurement, field).time))
            for tick, keep in zip(recording.ticks, counted, strict=True)
            if keep and getattr(tick.measurement, field) is not None
        ]
    ).reshape(-1, 2)
    return came[:, 0], came[:, 1]


def _thinned(time: FloatArray, values: FloatArray) -> tuple[list[float], list[float | None]]:
    """At most so many points, of neighbours the largest, so that peaks stay."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if not len(time):
        return [], []
    groups = np.array_split(np.arange(len(time)), min(_CHART_POINTS, len(time)))
    chosen = np.array([ticks[np.argmax(np.abs(values[ticks]))] for ticks in groups])
    return time[chosen].round(3).tolist(), [float(f"{value:.4g}") for value in values[chosen]]


# The figures of a replay; matplotlib is loaded when one is drawn.


def draw_path(
    recording: Recording, replayed: Replayed, references: Sequence[Reference], counted: BoolArray, path: Path
) -> None:
    """Poses as they came, what the estimator made of them, and what was tracked."""
    from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure  # noqa: PLC0415 - loads slowly

    came = [
        np.asarray(tick.measurement.pose.value, dtype=float)[:2]
        for tick, keep in zip(recording.ticks, counted, strict=True)
        if keep and tick.measurement.pose is not None
    ]
    with new_figure(path, 6.0, 6.0) as figure:
        axes = figure.subplots()
        for i, reference in enumerate(references):
            line = reference.sample(np.linspace(0.0, reference.duration, 1000)).pose
            label = "reference" if i == 0 else None
            axes.plot(line[:, 0], line[:, 1], color=REFERENCE_COLOUR, linewidth=3.0, alpha=0.5, label=label)
        if came:
            axes.plot(*np.array(came).T, ".", color=colour(4), markersize=2.0, label="poses")
        axes.plot(replayed.estimate[counted, 0], replayed.estimate[counted, 1], color=colour(0), label="estimate")
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axes.legend()
