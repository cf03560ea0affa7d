"""Figures of a tuning: error against effort of all points, and how the best objective fell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.tune.points import Point, Searched
from diffdrive_mpc.bench.figure_style import PALETTE, REFERENCE_COLOUR, new_figure


def draw_front(searched: Searched, path: Path) -> None:
    """Draw error and effort of the usable points, the front, the defaults and the chosen point."""
    with new_figure(path, 5.0, 3.8) as figure:
        axes = figure.add_subplot()
        usable, front = searched.usable, searched.front
        axes.plot(*_sides(usable), "o", color=REFERENCE_COLOUR, alpha=0.6, label="came through all fidelities")
        axes.plot(*_sides(front), "o-", color=PALETTE[0], label="no point is better in both")
        for one, name, mark, shade in (
            (searched.points[0], "defaults", "X", PALETTE[1]),
            (searched.best, "chosen", "*", PALETTE[2]),
        ):
            axes.plot(*_sides([one]), mark, color=shade, markersize=11, linestyle="none", label=name)
        axes.set(xlabel="effort, over that of the defaults", ylabel="error, over that of the defaults")
        axes.legend()


def draw_search(searched: Searched, path: Path) -> None:
    """Draw the objective of every point with the last fidelity it was driven with, and the best usable one so far."""
    with new_figure(path, 5.0, 3.2) as figure:
        axes = figure.add_subplot()
        for fidelity in sorted({one.fidelity for one in searched.points if one.fidelity}):
            some = [one for one in searched.points if one.fidelity == fidelity]
            axes.plot(
                [one.number for one in some],
                [one.value for one in some],
                "o",
                markersize=4,
                color=PALETTE[(fidelity + 4) % len(PALETTE)],
                label=f"fidelity {fidelity}",
            )
        usable = searched.usable
        best = np.minimum.accumulate([one.value for one in usable])
        axes.step([one.number for one in usable], best, where="post", color=PALETTE[0], label="best so far")
        axes.set(xlabel="point", ylabel="objective, over that of the defaults", yscale="log")
        axes.legend()


def _sides(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    return [one.effort for one in points], [one.error for one in points]
