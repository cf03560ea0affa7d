"""One run on one page: path with the error as colour, heading error, velocities against commands, errors over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from diffdrive_mpc.bench.figures.style import ERROR_MAP, REFERENCE_COLOUR, boxed_legend, colour, new_figure
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings


def draw_case(run: Run, title: str, path: Path) -> None:
    """Draw `run` into the PNG file `path`."""
    with new_figure(path, 10.0, 6.4) as figure:
        grid = figure.add_gridspec(4, 2, width_ratios=(1.25, 1.0))
        left = figure.add_subplot(grid[:, 0])
        right = [figure.add_subplot(grid[i, 1]) for i in range(4)]
        figure.suptitle(title)
        draw_path(figure, left, run)
        _velocity(right[0], run, 0, "v [m/s]")
        _velocity(right[1], run, 1, "omega [rad/s]")
        _heading_error(right[2], run)
        _position_errors(right[3], run)
        for axes in right[:-1]:
            axes.sharex(right[-1])
            axes.tick_params(labelbottom=False)
        right[-1].set_xlabel("time [s]")
        figure.align_ylabels(right)


def draw_path(figure: Figure, axes: Axes, run: Run) -> None:
    """Reference and driven path; the colour is the position error, the X its largest value."""
    position, error = run.true_pose[:, :2], 1e3 * run.errors.position
    axes.plot(*run.reference_pose[:, :2].T, color="black", linestyle="--", linewidth=0.7, label="reference", zorder=3)
    segments = np.stack([position[:-1], position[1:]], axis=1)
    driven = LineCollection(list(segments), cmap=ERROR_MAP, linewidths=3.4)
    driven.set_array(0.5 * (error[:-1] + error[1:]))
    axes.add_collection(driven)
    worst = int(np.argmax(np.where(run.counted, error, -np.inf)))
    label = f"largest error, {error[worst]:.1f} mm"
    axes.plot(*position[worst], "X", color="#D55E00", markersize=10, markeredgecolor="white", label=label, zorder=5)
    axes.plot(*position[0], "o", color="black", markersize=5, label="start", zorder=4)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.margins(0.08)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    figure.colorbar(driven, ax=axes, label="driven path: position error [mm]", shrink=0.7, pad=0.02)


def _velocity(axes: Axes, run: Run, channel: int, label: str) -> None:
    true = run.true_twist[:, (0, 2)[channel]]
    axes.plot(run.time, run.reference_twist[:, channel], color=REFERENCE_COLOUR, linestyle="--", label="reference")
    axes.step(run.time, run.command[:, channel], where="post", color=colour(1), linewidth=0.9, label="command")
    axes.plot(run.time, true, color=colour(0), label="true")
    axes.set_ylabel(label)
    if channel == 0:
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _heading_error(axes: Axes, run: Run) -> None:
    axes.plot(run.time, run.errors.heading, color=colour(0), label="heading")
    axes.plot(run.time, run.errors.course, color=colour(1), linewidth=0.9, label="course")
    axes.set_ylabel("angle error [rad]")
    boxed_legend(axes)


def _position_errors(axes: Axes, run: Run) -> None:
    axes.plot(run.time, 1e3 * run.errors.position, color=colour(0), label="position")
    axes.plot(run.time, 1e3 * run.errors.lateral, color=colour(1), linewidth=0.9, label="lateral")
    band = 1e3 * metric_settings().band
    if np.nanmax(np.abs(1e3 * run.errors.position)) > 0.5 * band:
        axes.axhspan(-band, band, color=REFERENCE_COLOUR, alpha=0.12, linewidth=0)
    axes.set_ylabel("error [mm]")
    boxed_legend(axes)
