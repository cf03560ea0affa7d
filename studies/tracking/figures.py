"""Figures of the tracking study: effect of each part of the estimator, sources of error, and delay margin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from pandas import DataFrame

from diffdrive_mpc.bench.chart_drawing import HATCHES, draw_charts
from diffdrive_mpc.bench.experiment import by, mean
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Series
from diffdrive_mpc.mpc import load_trajectory
from studies.tracking.measured import BOUND_NAME, ErrorParts, decompose

_BAR = 0.2
"""Width of a bar, relative to the distance of two groups [-]."""
_SOURCE_VARIANTS = ("none of them", "no side-slip", "everything on")
"""Variants in the figure of the sources of error."""
_PARTS = {
    "bias": "across, steady arcs (repeated)",
    "transient": "across, otherwise (repeated)",
    "along": "along the path (repeated)",
    "noise": "varies between seeds",
}
"""Labels of the fields of `ErrorParts`, from the bottom to the top of a stacked bar."""


def draw_ablation(rows: DataFrame, path: Path) -> None:
    """Draw the position error by surface and variant: means over models and seeds, and the range over trajectories."""
    variants = {**by(rows[rows["part"] == "ablation"], "variant"), BOUND_NAME: rows[rows["part"] == "bound"]}
    series = []
    for i, (name, variant) in enumerate(variants.items()):
        surfaces = by(variant, "surface")
        parts = [
            [1e3 * mean(runs, "position_rmse_m") for runs in by(surface_rows, "trajectory").values()]
            for surface_rows in surfaces.values()
        ]
        errors = [1e3 * mean(surface_rows, "position_rmse_m") for surface_rows in surfaces.values()]
        interval = ([min(part) for part in parts], [max(part) for part in parts])
        series.append(Series(name, list(surfaces), errors, i, "bars", *interval))
    axes = Axis("", "category"), Axis("position RMSE [mm]")
    draw_charts([Chart("Effect of each part of the estimator", *axes, series)], path, width=10.0)


def draw_margin(rows: DataFrame, path: Path) -> None:
    """Draw the position error against the delay margin of omega and against the change of omega_ref.

    Peers have no margin, so their error over the margin is a horizontal line.
    """
    margin_rows = rows[rows["part"] == "margin"]
    has_margin = margin_rows["margin"] != "-"
    interval = [float(margin_rows["margin"][has_margin].min()), float(margin_rows["margin"][has_margin].max())]
    by_margin, by_change = [], []
    for i, (name, runs) in enumerate(by(margin_rows, "driver").items()):
        points = by(runs, "margin")
        errors, changes = (
            [1e3 * mean(point, column) for point in points.values()] for column in ("position_rmse_m", "omega_change")
        )
        is_peer = "-" in points
        line = (interval, 2 * errors, i, "line") if is_peer else ([float(margin) for margin in points], errors, i)
        by_margin.append(Series(name, *line))
        by_change.append(Series(name, changes, errors, i, "points" if is_peer else "both"))
    error = Axis("position RMSE [mm]")
    charts = [
        Chart("Error against margin", Axis("margin of omega [s]"), error, by_margin),
        Chart("Error against smoothness", Axis("RMS change of omega_ref per tick [mrad/s]"), error, by_change),
    ]
    draw_charts(charts, path)


def draw_error_sources(rows: DataFrame, path: Path) -> None:
    """Draw errors over time and parts of the errors for selected variants and the bound.

    The figure shows the first model and the first surface of the ablation.
    """
    ablation_rows = rows[rows["part"] == "ablation"]
    model, surface = ablation_rows[["driver", "surface"]].iloc[0]
    variants = by(ablation_rows[(ablation_rows["driver"] == model) & (ablation_rows["surface"] == surface)], "variant")
    selected_variants = {name: variants[name] for name in _SOURCE_VARIANTS if name in variants} or variants
    bound = rows[(rows["part"] == "bound") & (rows["surface"] == surface)]
    if len(bound):
        selected_variants[BOUND_NAME] = bound
    trajectories = list(by(ablation_rows, "trajectory"))
    trajectory = "s" if "s" in trajectories else trajectories[0]
    with new_figure(path, 10.0, 6.6) as figure:
        grid = figure.add_gridspec(3, 1, height_ratios=(0.7, 1.3, 1.7))
        twist, across, bars = (figure.add_subplot(grid[i]) for i in range(3))
        twist.sharex(across)
        twist.tick_params(labelbottom=False)
        twist.set_title(f"Along the trajectory '{trajectory}': {model}, surface {surface}; mean and spread over seeds")
        _draw_twist(twist, trajectory)
        _draw_errors_over_time(
            across,
            {
                name: variant_rows[variant_rows["trajectory"] == trajectory]
                for name, variant_rows in selected_variants.items()
            },
        )
        _draw_shares(bars, selected_variants, trajectories)


def _draw_twist(axes: Axes, trajectory: str) -> None:
    reference = load_trajectory(trajectory)
    time = np.linspace(0.0, reference.duration, 1000)
    sample = reference.sample(time)
    axes.plot(time, sample.twist[:, 0], color=REFERENCE_COLOUR, label="v [m/s]")
    axes.plot(time, sample.twist[:, 1], color="black", linestyle="--", label="omega [rad/s]")
    axes.set_ylabel("reference")
    axes.legend(ncols=2, loc="upper right", frameon=True, framealpha=0.8, edgecolor="none")


def _draw_errors_over_time(axes: Axes, selected_variants: Mapping[str, DataFrame]) -> None:
    for k, (name, rows) in enumerate(selected_variants.items()):
        time, series = rows["time"].iloc[0], 1e3 * np.stack(list(rows["across"]))
        mean_error, spread = series.mean(axis=0), series.std(axis=0)
        axes.fill_between(time, mean_error - spread, mean_error + spread, color=colour(k), alpha=0.2, linewidth=0)
        axes.plot(time, mean_error, color=colour(k), linestyle=line_style(k), label=name)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set(xlabel="time [s]", ylabel="across the path [mm]")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_shares(axes: Axes, selected_variants: Mapping[str, DataFrame], trajectories: Sequence[str]) -> None:
    """Draw stacked bars of mean squares, which are additive, unlike root mean squares."""
    positions: list[float] = []
    labels: list[str] = []
    for i, trajectory in enumerate(trajectories):
        for k, (name, rows) in enumerate(selected_variants.items()):
            runs = rows[rows["trajectory"] == trajectory]
            x = i + (k - (len(selected_variants) - 1) / 2) * (_BAR + 0.04)
            _draw_stack(axes, x, decompose(runs), legend=not positions)
            positions.append(x)
            labels.append("bound" if name == BOUND_NAME else name.replace(" ", "\n"))
    axes.set_xticks(positions, labels, fontsize=7.0)
    for i, trajectory in enumerate(trajectories):
        axes.annotate(
            trajectory,
            (i, 1.0),
            (0, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            va="top",
            fontweight="bold",
        )
    axes.set_ylabel("mean square of the position\nerror [mm$^2$]; labels: RMS [mm]")
    axes.margins(y=0.22)
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def _draw_stack(axes: Axes, x: float, parts: ErrorParts, *, legend: bool) -> None:
    bottom = 0.0
    for k, (name, label) in enumerate(_PARTS.items()):
        # The unbiased estimate of a repeated error near zero can be negative.
        value = max(0.0, 1e6 * getattr(parts, name))
        axes.bar(
            x,
            value,
            _BAR,
            bottom=bottom,
            color=colour(k),
            hatch=HATCHES[k],
            edgecolor="white",
            linewidth=0.4,
            label=label if legend else None,
        )
        bottom += value
    rms = 1e3 * np.sqrt(parts.total)
    axes.annotate(f"{rms:.1f}", (x, bottom), (0, 2), textcoords="offset points", ha="center", fontsize=7.0)
