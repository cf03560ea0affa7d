"""The figures of the tracking study: what each part of the estimator is worth, and where the error comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.outcomes import by, group, mean
from diffdrive_mpc.mpc import load_trajectory
from studies.tracking.outcome import ErrorParts, ReducedOutcome, TrackingResults, decompose
from studies.tracking.plan import BOUND_NAME, variants

_HATCHES = ("", "//", "..", "\\\\", "xx", "--", "++")
_GROUP_WIDTH, _BAR = 0.84, 0.2
_PARTS = {
    "bias": "across, steady arcs (repeated)",
    "transient": "across, otherwise (repeated)",
    "along": "along the path (repeated)",
    "noise": "differs from seed to seed",
}


def draw_ablation(results: TrackingResults, path: Path) -> None:
    """Draw grouped bars by surface: mean over models, trajectories and seeds, with the range over trajectories."""
    names = variants(results.study)
    bounds = by("surface", results.parts.get("bound", ()))
    surfaces = by("surface", results.parts["ablation"])
    with new_figure(path, 10.0, 4.0) as figure:
        axes = figure.add_subplot()
        for i, (surface, rows) in enumerate(surfaces.items()):
            by_variant = group(rows, lambda one: names[one.case.overrides])
            for k, name in enumerate(names.values()):
                _bar(axes, i, k, len(names), by_variant[name], name if i == 0 else None)
            if surface in bounds:
                _bound(axes, i, bounds[surface], BOUND_NAME if i == 0 else None)
        axes.set_xticks(range(len(surfaces)), list(surfaces))
        axes.set(ylabel="position RMSE [mm]", title="What each part of the estimator is worth")
        axes.set_ylim(bottom=0)
        axes.grid(axis="x", visible=False)
        figure.legend(loc="outside lower center", ncols=4)


def _bar(axes: Axes, place: int, k: int, count: int, rows: Sequence[ReducedOutcome], label: str | None) -> None:
    width = _GROUP_WIDTH / count
    x = place + (k - (count - 1) / 2) * width
    value = 1e3 * mean(rows, "position_rmse_m")
    parts = [1e3 * mean(runs, "position_rmse_m") for runs in by("trajectory", rows).values()]
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


def _bound(axes: Axes, place: int, rows: Sequence[ReducedOutcome], label: str | None) -> None:
    value = 1e3 * mean(rows, "position_rmse_m")
    ends = [place - _GROUP_WIDTH / 2 - 0.03, place + _GROUP_WIDTH / 2 + 0.03]
    axes.plot(ends, [value, value], color="black", linestyle="--", linewidth=1.4, label=label)
    axes.annotate(f"{value:.1f}", (ends[1], value), (2, -3), textcoords="offset points", fontsize=7.5)


def draw_error_sources(results: TrackingResults, path: Path) -> None:
    """Draw the first model and surface of the ablation: some variants, and the bound."""
    part, names = results.study.ablation, variants(results.study)
    model, surface = part.models[0], part.surfaces[0]
    here = [one for one in results.parts["ablation"] if (one.case.model, one.case.surface) == (model, surface)]
    compared = {name: [one for one in here if names[one.case.overrides] == name] for name in part.drawn}
    bound = [one for one in results.parts.get("bound", ()) if one.case.surface == surface]
    if bound:
        compared[BOUND_NAME] = bound
    shown = "s" if "s" in results.study.trajectories else results.study.trajectories[0]
    with new_figure(path, 10.0, 6.6) as figure:
        grid = figure.add_gridspec(3, 1, height_ratios=(0.7, 1.3, 1.7))
        twist, across, bars = (figure.add_subplot(grid[i]) for i in range(3))
        twist.sharex(across)
        twist.tick_params(labelbottom=False)
        twist.set_title(
            f"Along the trajectory '{shown}': {model.upper()}, surface {surface}; mean and spread over seeds"
        )
        _twist(twist, shown)
        _over_time(across, {name: [r for r in rows if r.case.trajectory == shown] for name, rows in compared.items()})
        _shares(bars, compared, results.study.trajectories)


def _twist(axes: Axes, trajectory: str) -> None:
    reference = load_trajectory(trajectory)
    time = np.linspace(0.0, reference.duration, 1000)
    sample = reference.sample(time)
    axes.plot(time, sample.twist[:, 0], color=REFERENCE_COLOUR, label="v [m/s]")
    axes.plot(time, sample.twist[:, 1], color="black", linestyle="--", label="omega [rad/s]")
    axes.set_ylabel("reference")
    axes.legend(ncols=2, loc="upper right", frameon=True, framealpha=0.8, edgecolor="none")


def _over_time(axes: Axes, compared: Mapping[str, Sequence[ReducedOutcome]]) -> None:
    for k, (name, rows) in enumerate(compared.items()):
        time, series = rows[0].time, 1e3 * np.array([one.across for one in rows])
        middle, spread = series.mean(axis=0), series.std(axis=0)
        axes.fill_between(time, middle - spread, middle + spread, color=colour(k), alpha=0.2, linewidth=0)
        axes.plot(time, middle, color=colour(k), linestyle=line_style(k), label=name)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set(xlabel="time [s]", ylabel="across the path [mm]")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _shares(axes: Axes, compared: Mapping[str, Sequence[ReducedOutcome]], trajectories: tuple[str, ...]) -> None:
    """Stacked bars: mean squares add up where root mean squares do not."""
    places: list[float] = []
    labels: list[str] = []
    for i, trajectory in enumerate(trajectories):
        for k, (name, rows) in enumerate(compared.items()):
            runs = [one for one in rows if one.case.trajectory == trajectory]
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
        # Taking the noise off a repeated error near zero can leave less than nothing.
        value = max(0.0, 1e6 * getattr(parts, name))
        axes.bar(
            x,
            value,
            _BAR,
            bottom=below,
            color=colour(k),
            hatch=_HATCHES[k],
            edgecolor="white",
            linewidth=0.4,
            label=label if legend else None,
        )
        below += value
    rms = 1e3 * np.sqrt(parts.total)
    axes.annotate(f"{rms:.1f}", (x, below), (0, 2), textcoords="offset points", ha="center", fontsize=7.0)
