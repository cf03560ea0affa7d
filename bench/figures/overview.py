"""One figure that says it all: paths of the best controller, errors of all of them, and their step times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.step_time import tail_of_step_times
from diffdrive_mpc.bench.figures.style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.groups import by_trajectory, groups, mean
from diffdrive_mpc.bench.runner import Outcome


def draw_overview(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw reference against driven path of the controller with the least position RMSE, and compare all of them."""
    compared = groups(outcomes)
    best = min(compared, key=lambda name: np.nan_to_num(mean(compared[name], "position_rmse_m"), nan=np.inf))
    driven = by_trajectory(compared[best])
    with new_figure(path, 10.0, 6.0) as figure:
        halves = figure.add_gridspec(2, 1, height_ratios=(1.0, 1.05))
        upper, lower = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
        upper.suptitle(f"Driven with {best}, first seed")
        paths = upper.subplots(1, len(driven), squeeze=False)[0]
        for axes, (trajectory, runs) in zip(paths, driven.items(), strict=True):
            _path(axes, runs[0])
            axes.set_title(f"{trajectory}, RMSE {1e3 * mean(runs, 'position_rmse_m'):.1f} mm")
        paths[0].legend(loc="center")
        errors, times = lower.subplots(1, 2)
        _bars(errors, compared)
        tail_of_step_times(times, outcomes)


def _path(axes: Axes, outcome: Outcome) -> None:
    run = outcome.run
    axes.plot(*run.reference_pose[:, :2].T, color=REFERENCE_COLOUR, linewidth=3.0, label="reference")
    axes.plot(*run.true_pose[:, :2].T, color=colour(1), linewidth=1.1, label="driven")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def _bars(axes: Axes, compared: dict[str, list[Outcome]]) -> None:
    """Mean position RMSE with the range over trajectories."""
    for i, group in enumerate(compared.values()):
        parts = [1e3 * mean(runs, "position_rmse_m") for runs in by_trajectory(group).values()]
        value = 1e3 * mean(group, "position_rmse_m")
        axes.bar(i, value, 0.6, color=colour(i), alpha=0.85)
        axes.plot([i, i], [min(parts), max(parts)], color="black", linewidth=1.0, marker="_", markersize=8)
        axes.annotate(f"{value:.1f}", (i + 0.06, value), (2, 2), textcoords="offset points", ha="left")
    turned = 20 if len(compared) > 4 else 0
    axes.set_xticks(range(len(compared)), list(compared), rotation=turned, ha="right" if turned else "center")
    axes.set(ylabel="position RMSE [mm]", title="mean, and range over trajectories")
    axes.grid(axis="x", visible=False)
