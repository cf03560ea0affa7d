"""Tracking error and step time against the horizon: the figure to choose a horizon from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import MARKERS, colour, line_style, new_figure
from diffdrive_mpc.bench.groups import by_horizon, by_model, mean, step_times
from diffdrive_mpc.bench.runner import Outcome


def draw_horizons(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw mean position RMSE, mean heading RMSE and the 99th percentile of the step time against the horizon."""
    with new_figure(path, 10.0, 3.4) as figure:
        position, heading, cost = figure.subplots(1, 3)
        for i, (name, group) in enumerate(by_model(outcomes).items()):
            at = by_horizon(group)
            look = {"color": colour(i), "linestyle": line_style(i), "marker": MARKERS[i % len(MARKERS)], "label": name}
            steps = list(at)
            position.plot(steps, [1e3 * mean(runs, "position_rmse_m") for runs in at.values()], **look)
            heading.plot(steps, [1e3 * mean(runs, "heading_rmse_rad") for runs in at.values()], **look)
            cost.plot(steps, [1e3 * float(np.percentile(step_times(runs), 99)) for runs in at.values()], **look)
        labels = ("position RMSE [mm]", "heading RMSE [mrad]", "step p99 [ms]")
        for axes, label in zip((position, heading, cost), labels, strict=True):
            axes.set(xlabel=f"horizon [steps of {1e3 * outcomes[0].run.sample_time:.1f} ms]", ylabel=label)
            _scale(axes)
        position.legend()


def _scale(axes: Axes) -> None:
    """Start at zero, unless one value would press all others flat."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()])
    values = values[np.isfinite(values) & (values > 0)]
    if values.size and values.max() > 20 * values.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
