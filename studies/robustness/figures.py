"""The figure of the study: which controller is how far behind the best one, condition by condition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import by
from diffdrive_mpc.bench.figure_style import ERROR_MAP, new_figure
from studies.robustness.results import ratios

_MOST = 10.0
"""Ratio from which on the colour is the same."""


def draw_ratios(rows: DataFrame, path: Path) -> None:
    """Draw a heat map: a row for each condition, a column for each controller, the ratio written in each cell.

    A cross marks a controller that did not complete every run.
    """
    conditions, names = by(rows, "condition"), list(by(rows, "driver"))
    values = np.array([[ratios(own).get(name, np.nan) for name in names] for own in conditions.values()])
    with new_figure(path, 2.6 + 0.7 * len(names), 1.2 + 0.19 * len(conditions)) as figure:
        axes = figure.add_subplot()
        shown = axes.imshow(np.clip(values, 1.0, _MOST), norm=LogNorm(1.0, _MOST), cmap=ERROR_MAP, aspect="auto")
        axes.set_xticks(range(len(names)), names, rotation=30, ha="left")
        axes.xaxis.tick_top()
        axes.set_yticks(range(len(conditions)), list(conditions), fontsize=7)
        axes.grid(visible=False)
        for i, own in enumerate(conditions.values()):
            for k, name in enumerate(names):
                lost = not own[own["driver"] == name]["completed"].all()
                ratio = f"{values[i, k]:.2f}" if np.isfinite(values[i, k]) else "-"
                dark = not values[i, k] > _MOST**0.5
                text = f"{ratio} ×" if lost else ratio
                axes.text(k, i, text, ha="center", va="center", fontsize=6.5, color="white" if dark else "black")
        figure.colorbar(shown, ax=axes, label="position RMSE over the best one's", shrink=0.4)
