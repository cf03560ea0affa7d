"""Open-loop odometry of MBM and SM: paths, and errors beside the published ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.reproduce.experiments.mbm_and_sm import COMPARED, SM, MbmSmResult
from diffdrive_mpc.bench.reproduce.published import load_published
from diffdrive_mpc.models.interface import FloatArray

_BAR = 0.16
_QUANTITIES = {"position": "m", "heading": "rad"}


def draw_odometry(results: Sequence[MbmSmResult], path: Path) -> None:
    """Draw the paths of the first repetition, and the mean RMSE over all of them."""
    first = results[0]
    with new_figure(path, 10.0, 6.2) as figure:
        halves = figure.add_gridspec(2, 1)
        upper, lower = (figure.add_subfigure(halves[row]) for row in (0, 1))
        upper.suptitle("Driven on the simulated robot, and predicted from commands alone")
        for axes, (name, paths) in zip(
            upper.subplots(1, len(first.paths), squeeze=False)[0], first.paths.items(), strict=True
        ):
            _paths(axes, paths)
            axes.set_title(name)
            if name == next(iter(first.paths)):
                axes.legend(loc="center", fontsize=7.0)
        for axes, quantity in zip(lower.subplots(1, 2), _QUANTITIES, strict=True):
            _bars(axes, results, quantity)
        lower.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=5)


def _paths(axes: Axes, paths: Mapping[str, FloatArray]) -> None:
    axes.plot(*paths["driven"][:, :2].T, color=REFERENCE_COLOUR, linewidth=3.0, label="driven")
    for k, model in enumerate(COMPARED):
        axes.plot(*paths[model][:, :2].T, color=colour(k), linestyle=line_style(k), linewidth=1.1, label=model)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def _bars(axes: Axes, results: Sequence[MbmSmResult], quantity: str) -> None:
    names = list(results[0].errors[SM])
    printed = load_published().odometry
    bars: dict[str, tuple[list[float], str, str]] = {
        f"published {model.upper()}": (
            [getattr(printed[model][name], quantity)[0] for name in names],
            colour(0 if model == "mbm" else 2),
            "//",
        )
        for model in ("mbm", "sm")
    }
    for k, model in enumerate(COMPARED):
        values = [
            float(np.mean([getattr(result.errors[model][name], quantity).rmse for result in results])) for name in names
        ]
        bars[model] = (values, colour(k), "")
    for k, (label, (values, shade, hatch)) in enumerate(bars.items()):
        places = np.arange(len(names)) + (k - 2) * _BAR
        axes.bar(places, values, _BAR, color=shade, hatch=hatch, edgecolor="white", linewidth=0.4, label=label)
    axes.set(yscale="log", ylabel=f"{quantity} RMSE [{_QUANTITIES[quantity]}]", title=quantity)
    axes.set_xticks(range(len(names)), names)
    axes.grid(axis="x", visible=False)
