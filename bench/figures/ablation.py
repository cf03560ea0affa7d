"""What each part of the estimator is worth: position RMSE with parts left out, and the bound."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import colour, new_figure
from diffdrive_mpc.bench.tracking.results import StudyResults, group, mean
from diffdrive_mpc.bench.tracking.row import Row
from diffdrive_mpc.bench.tracking.variants import BOUND_NAME, variant_names, variants

_HATCHES = ("", "//", "..", "\\\\", "xx", "--", "++")
_GROUP_WIDTH = 0.84


def draw_ablation(results: StudyResults, path: Path) -> None:
    """Draw grouped bars by surface: mean over models, trajectories and seeds, with the range over trajectories."""
    names = variants(results.study)
    bounds = group(results.parts.get("bound", ()), lambda row: row.case.labels["surface"])
    surfaces = group(results.parts["ablation"], lambda row: row.case.labels["surface"])
    with new_figure(path, 10.0, 4.0) as figure:
        axes = figure.add_subplot()
        for i, (surface, rows) in enumerate(surfaces.items()):
            by = group(rows, lambda row: names[row.case.overrides])
            for k, name in enumerate(variant_names(results.study)):
                _bar(axes, i, k, len(names), by[name], name if i == 0 else None)
            if surface in bounds:
                _bound(axes, i, bounds[surface], BOUND_NAME if i == 0 else None)
        axes.set_xticks(range(len(surfaces)), list(surfaces))
        axes.set(ylabel="position RMSE [mm]", title="What each part of the estimator is worth")
        axes.set_ylim(bottom=0)
        axes.grid(axis="x", visible=False)
        figure.legend(loc="outside lower center", ncols=4)


def _bar(axes: Axes, place: int, k: int, count: int, rows: list[Row], label: str | None) -> None:
    width = _GROUP_WIDTH / count
    x = place + (k - (count - 1) / 2) * width
    value = 1e3 * mean(rows, "position_rmse_m")
    parts = [
        1e3 * mean(runs, "position_rmse_m") for runs in group(rows, lambda row: row.case.labels["trajectory"]).values()
    ]
    axes.bar(
        x,
        value,
        0.92 * width,
        color=colour(k),
        hatch=_HATCHES[k % len(_HATCHES)],
        alpha=0.85,
        edgecolor="white",
        label=label,
    )
    axes.plot([x, x], [min(parts), max(parts)], color="black", linewidth=0.9, marker="_", markersize=5)
    axes.annotate(f"{value:.1f}", (x + 0.02, value), (1, 2), textcoords="offset points", ha="left", fontsize=7.5)


def _bound(axes: Axes, place: int, rows: list[Row], label: str | None) -> None:
    value = 1e3 * float(np.mean([row.metrics.position_rmse_m for row in rows]))
    ends = [place - _GROUP_WIDTH / 2 - 0.03, place + _GROUP_WIDTH / 2 + 0.03]
    axes.plot(ends, [value, value], color="black", linestyle="--", linewidth=1.4, label=label)
    axes.annotate(f"{value:.1f}", (ends[1], value), (2, -3), textcoords="offset points", fontsize=7.5)
