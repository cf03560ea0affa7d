"""Printed tests of a virtual track, and three lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.reproduce.experiments.virtual_track import TrackLine, VirtualTrackResult
from diffdrive_mpc.models.interface import FloatArray


def draw_virtual_track(result: VirtualTrackResult, path: Path) -> None:
    """Draw the tests as printed and with tracks exchanged, each with the printed line and the one fitted to it."""
    with new_figure(path, 9.0, 3.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw(left, result.tests, result.printed, result.fitted)
        _draw(right, result.exchanged, result.printed, result.fitted_exchanged)
        left.set(title="tests as printed", ylabel="virtual track [m]")
        right.set_title("tracks of tests 1, 2 and 7, 8 exchanged")


def _draw(axes: Axes, tests: FloatArray, printed: TrackLine, fitted: TrackLine) -> None:
    rates = np.array([0.0, 1.1])
    for k, (name, line) in enumerate({"printed": printed, "least squares": fitted}.items()):
        label = f"{name}: {line.p1:.3f} |yaw rate| + {line.p0:.3f}"
        axes.plot(rates, line.p1 * rates + line.p0, color=colour(k), linestyle=line_style(k), label=label)
    axes.plot(*tests.T, "o", color="black", markersize=4.0)
    for number, (rate, track) in enumerate(tests, start=1):
        axes.annotate(str(number), (rate, track), (4, 3), textcoords="offset points", fontsize=7.0)
    axes.axhline(printed.p0, color=REFERENCE_COLOUR, linewidth=0.8)
    axes.annotate("true track", (1.1, printed.p0), (-36, -9), textcoords="offset points", fontsize=7.0)
    axes.set_xlabel("yaw rate [rad/s]")
    axes.legend(loc="lower center")
    axes.margins(y=0.15)
