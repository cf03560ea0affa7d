"""Figures of a proof: a map of two factors with the boundary of the band, and the distribution of the error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import ArrayLike

from diffdrive_mpc.app.proof.maps import Drawn
from diffdrive_mpc.bench.figure_style import ERROR_MAP, PALETTE, REFERENCE_COLOUR, new_figure
from diffdrive_mpc.bench.statistics import Estimate
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings


def draw_map(drawn: Drawn, path: Path) -> None:
    """Draw the position error as colour, the boundary of the band as a line, and a cross where a run did not end."""
    band, x, y = metric_settings().band, drawn.of.x, drawn.of.y
    with new_figure(path, 5.0, 3.8) as figure:
        axes = figure.add_subplot()
        error = 1e3 * np.where(np.isfinite(drawn.error), drawn.error, np.nan)
        low, high = float(np.nanmin(error)), float(np.nanmax(error))
        colours = axes.pcolormesh(
            x.values, y.values, error, norm=LogNorm(low, max(high, 1.001 * low)), cmap=ERROR_MAP, shading="nearest"
        )
        # What did not come to its end is outside, however near to the path it stopped.
        outside = np.where(drawn.completed > 0.0, np.nan_to_num(drawn.lateral, nan=2.0 * band), 2.0 * band)
        if outside.min() <= band < outside.max():
            axes.contour(x.values, y.values, outside, levels=[band], colors=[PALETTE[1]], linewidths=2.0)
        lost = np.argwhere(drawn.completed == 0.0)
        if lost.size:
            axes.plot(
                np.array(x.values)[lost[:, 1]],
                np.array(y.values)[lost[:, 0]],
                "X",
                color="white",
                markeredgecolor="black",
            )
        axes.set(xlabel=x.factor, ylabel=y.factor)
        axes.grid(visible=False)
        figure.colorbar(colours, ax=axes, label="position RMSE [mm]")


def draw_errors(errors: ArrayLike, tail: Estimate, path: Path) -> None:
    """Draw the share of completed runs with a larger position RMSE [m] than a given one, and CVaR with its interval."""
    ordered = 1e3 * np.sort(np.asarray(errors, dtype=float))
    with new_figure(path, 5.0, 3.2) as figure:
        axes = figure.add_subplot()
        axes.step(ordered, 1.0 - np.arange(ordered.size) / ordered.size, where="pre", color=PALETTE[0])
        axes.axvline(1e3 * tail.value, color=PALETTE[1], label=f"CVaR 95 %: {1e3 * tail.value:.1f} mm")
        if np.isfinite(tail.low):
            axes.axvspan(1e3 * tail.low, 1e3 * tail.high, color=PALETTE[1], alpha=0.2, linewidth=0.0)
        axes.axhline(0.05, color=REFERENCE_COLOUR, linestyle=":")
        axes.set(xscale="log", yscale="log", xlabel="position RMSE [mm]", ylabel="share of completed runs with more")
        # The errors of few runs may be nearly the same: an axis needs some width.
        if ordered.size:
            axes.set_xlim(0.9 * ordered[0], 1.1 * max(ordered[-1], 1e3 * tail.value))
        axes.legend()
