"""Where the error comes from: along one trajectory over time, and as shares of the mean square on all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.tracking.decomposition import ErrorParts, decompose
from diffdrive_mpc.bench.tracking.results import StudyResults, group
from diffdrive_mpc.bench.tracking.row import Row
from diffdrive_mpc.bench.tracking.variants import BOUND_NAME, variants
from diffdrive_mpc.mpc import load_trajectory

_PARTS = {
    "bias": "across, steady arcs (repeated)",
    "transient": "across, otherwise (repeated)",
    "along": "along the path (repeated)",
    "noise": "differs from seed to seed",
}
_HATCHES = ("", "//", "..", "xx")
_BAR = 0.2


def draw_error_sources(results: StudyResults, path: Path) -> None:
    """Draw the first model and surface of the ablation: some variants, and the bound."""
    part, names = results.study.ablation, variants(results.study)
    model, surface = part.models[0], part.surfaces[0]
    here = [row for row in results.parts["ablation"] if (row.case.model, row.case.surface) == (model, surface)]
    compared = {name: [row for row in here if names[row.case.overrides] == name] for name in part.drawn}
    bound = [row for row in results.parts.get("bound", ()) if row.case.surface == surface]
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


def _over_time(axes: Axes, compared: dict[str, list[Row]]) -> None:
    for k, (name, rows) in enumerate(compared.items()):
        time, series = rows[0].time, 1e3 * np.array([row.across for row in rows])
        middle, spread = series.mean(axis=0), series.std(axis=0)
        axes.fill_between(time, middle - spread, middle + spread, color=colour(k), alpha=0.2, linewidth=0)
        axes.plot(time, middle, color=colour(k), linestyle=line_style(k), label=name)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set(xlabel="time [s]", ylabel="across the path [mm]")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _shares(axes: Axes, compared: dict[str, list[Row]], trajectories: tuple[str, ...]) -> None:
    """Stacked bars: mean squares add up where root mean squares do not."""
    places: list[float] = []
    labels: list[str] = []
    for i, trajectory in enumerate(trajectories):
        for k, (name, rows) in enumerate(compared.items()):
            runs = group(rows, lambda row: row.case.trajectory)[trajectory]
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
