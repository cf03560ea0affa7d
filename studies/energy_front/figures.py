"""The figure of the front."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.bench.figure_style import MARKERS, colour, new_figure

if TYPE_CHECKING:
    from studies.energy_front.study import Fronts


def draw_front(fronts: Fronts, path: Path) -> None:
    """Energy over that without a weight against position RMSE, a panel for each floor; runs that arrived."""
    floors = list(dict.fromkeys(floor for floor, _ in fronts))
    with new_figure(path, 7.2, 3.4) as figure:
        for axes, floor in zip(np.ravel(figure.subplots(1, len(floors), sharey=True)), floors, strict=True):
            for k, (name, points) in enumerate((name, points) for (on, name), points in fronts.items() if on == floor):
                kept = [point for point in points if point.completed == point.of]
                error = np.array([[1e3 * part for part in vars(point.error).values()] for point in kept])
                energy = np.array([[100 * (1 - part) for part in vars(point.saved).values()] for point in kept])
                axes.errorbar(
                    error[:, 0],
                    energy[:, 0],
                    xerr=np.nan_to_num(np.abs(error[:, 1:] - error[:, :1]).T),
                    yerr=np.nan_to_num(np.abs(energy[:, 1:] - energy[:, :1]).T),
                    fmt=f"{MARKERS[k]}-",
                    color=colour(k),
                    markersize=4,
                    linewidth=1,
                    label=name,
                )
            axes.set(xscale="log", xlabel="position RMSE [mm]", title=f"'{floor}'")
            axes.legend()
        figure.axes[0].set_ylabel("energy, over that without weight [%]")
