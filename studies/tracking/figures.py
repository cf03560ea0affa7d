"""Figures of the tracking study: the effect of each part of the estimator, the causes of errors, and the margin."""

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
_SOURCE_VARIANTS = ("none of them", "no side-slip", "everything on")
"""Variants in the figure of the sources of error."""
_PARTS = {
    "bias": "across, steady arcs (repeated)",
    "transient": "across, otherwise (repeated)",
    "along": "along the path (repeated)",
    "noise": "differs from seed to seed",
}


def draw_ablation(rows: DataFrame, path: Path) -> None:
    """Draw bars grouped by surface: means over models, trajectories and seeds, with the range over trajectories."""
    variants = {**by(rows[rows["part"] == "ablation"], "variant"), BOUND_NAME: rows[rows["part"] == "bound"]}
    series = []
    for i, (name, variant) in enumerate(variants.items()):
        surfaces = by(variant, "surface")
        parts = [
            [1e3 * mean(runs, "position_rmse_m") for runs in by(surface_rows, "trajectory").values()]
            for surface_rows in surfaces.values()
        ]
        errors = [1e3 * mean(surface_rows, "position_rmse_m") for surface_rows in surfaces.values()]
        ends = ([min(part) for part in parts], [max(part) for part in parts])
        series.append(Series(name, list(surfaces), errors, i, "bars", *ends))
    axes = Axis("", "category"), Axis("position RMSE [mm]")
    draw_charts([Chart("What each part of the estimator is worth", *axes, series)], path, width=10.0)


def draw_margin(rows: DataFrame, path: Path) -> None:
    """Draw the position error against the margin of omega, which peers do not have, and the change of omega_ref."""
    driven = rows[rows["part"] == "margin"]
    has_margin = driven["margin"] != "-"
    ends = [float(driven["margin"][has_margin].min()), float(driven["margin"][has_margin].max())]
    by_margin, by_change = [], []
    for i, (name, runs) in enumerate(by(driven, "driver").items()):
        points = by(runs, "margin")
        errors, changes = (
            [1e3 * mean(point, column) for point in points.values()] for column in ("position_rmse_m", "omega_change")
        )
        is_peer = "-" in points
        line = (ends, 2 * errors, i, "line") if is_peer else ([float(margin) for margin in points], errors, i)
        by_margin.append(Series(name, *line))
        by_change.append(Series(name, changes, errors, i, "points" if is_peer else "both"))
    error = Axis("position RMSE [mm]")
    charts = [
        Chart("Error against margin", Axis("margin of omega [s]"), error, by_margin),
        Chart("Error against smoothness", Axis("RMS change of omega_ref per tick [mrad/s]"), error, by_change),
    ]
    draw_charts(charts, path)


def draw_error_sources(rows: DataFrame, path: Path) -> None:
    """Draw the error of selected variants and of the bound, for the first model and surface of the ablation."""
    ablated = rows[rows["part"] == "ablation"]
    model, surface = ablated[["driver", "surface"]].iloc[0]
    variants = by(ablated[(ablated["driver"] == model) & (ablated["surface"] == surface)], "variant")
    compared = {name: variants[name] for name in _SOURCE_VARIANTS if name in variants} or variants
    bound = rows[(rows["part"] == "bound") & (rows["surface"] == surface)]
    if len(bound):
        compared[BOUND_NAME] = bound
    trajectories = list(by(ablated, "trajectory"))
    trajectory = "s" if "s" in trajectories else trajectories[0]
    with new_figure(path, 10.0, 6.6) as figure:
        grid = figure.add_gridspec(3, 1, height_ratios=(0.7, 1.3, 1.7))
        twist, across, bars = (figure.add_subplot(grid[i]) for i in range(3))
        twist.sharex(across)
        twist.tick_params(labelbottom=False)
        twist.set_title(f"Along the trajectory '{trajectory}': {model}, surface {surface}; mean and spread over seeds")
        _twist(twist, trajectory)
        _over_time(
            across,
            {
                name: rows_of_variant[rows_of_variant["trajectory"] == trajectory]
                for name, rows_of_variant in compared.items()
            },
        )
        _shares(bars, compared, trajectories)


def _twist(axes: Axes, trajectory: str) -> None:
    reference = load_trajectory(trajectory)
    time = np.linspace(0.0, reference.duration, 1000)
    sample = reference.sample(time)
    axes.plot(time, sample.twist[:, 0], color=REFERENCE_COLOUR, label="v [m/s]")
    axes.plot(time, sample.twist[:, 1], color="black", linestyle="--", label="omega [rad/s]")
    axes.set_ylabel("reference")
    axes.legend(ncols=2, loc="upper right", frameon=True, framealpha=0.8, edgecolor="none")


def _over_time(axes: Axes, compared: Mapping[str, DataFrame]) -> None:
    for k, (name, rows) in enumerate(compared.items()):
        time, series = rows["time"].iloc[0], 1e3 * np.stack(list(rows["across"]))
        middle, spread = series.mean(axis=0), series.std(axis=0)
        axes.fill_between(time, middle - spread, middle + spread, color=colour(k), alpha=0.2, linewidth=0)
        axes.plot(time, middle, color=colour(k), linestyle=line_style(k), label=name)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set(xlabel="time [s]", ylabel="across the path [mm]")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _shares(axes: Axes, compared: Mapping[str, DataFrame], trajectories: Sequence[str]) -> None:
    """Draw stacked bars of mean squares, which are additive, unlike root mean squares."""
    places: list[float] = []
    labels: list[str] = []
    for i, trajectory in enumerate(trajectories):
        for k, (name, rows) in enumerate(compared.items()):
            runs = rows[rows["trajectory"] == trajectory]
            x = i + (k - (len(compared) - 1) / 2) * (_BAR + 0.04)
            _stack(axes, x, decompose(runs), legend=not places)
            places.append(x)
            labels.append("bound" if name == BOUND_NAME else name.replace(" ", "\n"))
    axes.set_xticks(places, labels, fontsize=7.0)
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
    axes.set_ylabel("mean square of the position\nerror [mm$^2$]; on top RMS [mm]")
    axes.margins(y=0.22)
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def _stack(axes: Axes, x: float, parts: ErrorParts, *, legend: bool) -> None:
    below = 0.0
    for k, (name, label) in enumerate(_PARTS.items()):
        # The unbiased estimate of a repeated error near zero can be negative.
        value = max(0.0, 1e6 * getattr(parts, name))
        axes.bar(
            x,
            value,
            _BAR,
            bottom=below,
            color=colour(k),
            hatch=HATCHES[k],
            edgecolor="white",
            linewidth=0.4,
            label=label if legend else None,
        )
        below += value
    rms = 1e3 * np.sqrt(parts.total)
    axes.annotate(f"{rms:.1f}", (x, below), (0, 2), textcoords="offset points", ha="center", fontsize=7.0)
