"""The figures of a replay; matplotlib is loaded when one is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.app.replay.statistics import NAMES
from diffdrive_mpc.bench.html_report.numbers import from_zero
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.logs.record import BoolArray

_UNITS = (("v", "m/s"), ("omega", "rad/s"))


def draw_commands(
    recording: Recording, replayed: Replayed, other: FloatArray | None, counted: BoolArray, path: Path
) -> None:
    """Recorded and replayed commands over time, and by how much they differ."""
    from diffdrive_mpc.bench.figure_style import colour, line_style, new_figure  # noqa: PLC0415 - loads slowly

    time, title = from_zero(recording.time[counted])
    shown = {"recorded": recording.command, "replayed": replayed.command}
    if other is not None:
        shown["other"] = other
    with new_figure(path, 9.0, 6.0) as figure:
        axes = figure.subplots(4, 1, sharex=True, height_ratios=(3, 1, 3, 1))
        for column, (name, unit) in enumerate(_UNITS):
            for i, (who, rows) in enumerate(shown.items()):
                style = {"color": colour(i), "linestyle": line_style(i)}
                axes[2 * column].plot(time, rows[counted, column], label=who, **style)
            axes[2 * column].set(ylabel=f"{name} [{unit}]")
            apart = replayed.command[counted, column] - recording.command[counted, column]
            axes[2 * column + 1].plot(time, apart, color=colour(1))
            axes[2 * column + 1].set(ylabel=f"difference\n[{unit}]")
        axes[0].legend(ncols=3)
        axes[-1].set(xlabel=title)


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


def draw_trust(recording: Recording, replayed: Replayed, counted: BoolArray, path: Path) -> None:
    """Age of what each tick got, and how it fits to what was predicted."""
    from diffdrive_mpc.bench.figure_style import MARKERS, colour, new_figure  # noqa: PLC0415 - loads slowly

    begin = recording.time[counted][0]
    time, title = from_zero(recording.time[counted])
    with new_figure(path, 9.0, 4.6) as figure:
        ages, fits = figure.subplots(2, 1, sharex=True)
        for i, (field, name) in enumerate(NAMES.items()):
            came = [
                (tick.time - begin, 1e3 * (tick.time - getattr(tick.measurement, field).time))
                for tick, keep in zip(recording.ticks, counted, strict=True)
                if keep and getattr(tick.measurement, field) is not None
            ]
            if came:
                ages.plot(*np.array(came).T, MARKERS[i], color=colour(i), markersize=2.0, label=name)
        ages.set(ylabel="age at the tick [ms]")
        ages.legend(ncols=3)
        for i, (column, name) in enumerate(((3, "poses"), (0, "wheels, v"), (2, "gyro"))):
            values = replayed.innovations[counted, column]
            fits.plot(time, values, MARKERS[i], color=colour(i), markersize=2.0, label=name)
        fits.axhline(1.0, color="black", linewidth=0.8)
        fits.set(yscale="log", ylim=(1e-3, None), ylabel="innovation² / variance [-]", xlabel=title)
        fits.legend(ncols=3)
