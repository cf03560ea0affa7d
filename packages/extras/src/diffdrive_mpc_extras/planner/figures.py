"""The way with its turns by colour, and the power along it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.patches import Polygon

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.planner.clearance import outline
from diffdrive_mpc_extras.worlds.drawing import draw_world

if TYPE_CHECKING:
    from diffdrive_mpc_extras.planner.study import PlanRequest, Plans

_WIDEST = 50.0
_OUTLINES = 12


def draw_paths(request: PlanRequest, plans: Plans, path: Path) -> None:
    """The chosen way by commanded radius, the robot along it, the others dashed."""
    chosen = plans[request.minimise]
    with new_figure(path, 6.4, 5.2) as figure:
        axes = figure.subplots()
        if request.world is not None:
            draw_world(axes, request.world)
        for k, (name, plan) in enumerate(plans.items()):
            if name != request.minimise:
                label = f"{name}: {plan.energy:.0f} J, {plan.length:.1f} m"
                axes.plot(plan.poses[:, 0], plan.poses[:, 1], "--", color=colour(k + 1), label=label)
        lines = _coloured(axes, chosen.poses, chosen.commands, chosen.sharpest)
        axes.plot([], [], color=colour(0), label=f"{request.minimise}: {chosen.energy:.0f} J, {chosen.length:.1f} m")
        corners = outline(request.costs.vehicle).corners
        for x, y, theta in chosen.poses[np.linspace(0, len(chosen.poses) - 1, _OUTLINES).astype(int)].tolist():
            c, s = np.cos(theta), np.sin(theta)
            placed = corners @ np.array([[c, s], [-s, c]]) + (x, y)
            axes.add_patch(Polygon(placed, fill=False, edgecolor=REFERENCE_COLOUR, linewidth=0.6))
        if len(request.via):
            axes.plot(*request.via.T, "x", color=REFERENCE_COLOUR, label="via")
        figure.colorbar(lines, ax=axes, label="commanded radius [m]", shrink=0.8)
        axes.set(
            xlabel="x [m]", ylabel="y [m]", aspect="equal", title=f"Least {request.minimise} on '{request.costs.name}'"
        )
        axes.margins(0.08)
        axes.legend(loc="best")


def draw_power(request: PlanRequest, plans: Plans, path: Path) -> None:
    """Predicted power of every plan over time."""
    with new_figure(path, 6.4, 3.2) as figure:
        axes = figure.subplots()
        for k, (name, plan) in enumerate(plans.items()):
            times = plan.sample_time * np.arange(len(plan.power))
            style = "-" if name == request.minimise else line_style(k + 1)
            axes.plot(times, plan.power, style, color=colour(k), label=f"{name}, {plan.energy:.0f} J")
        axes.set(xlabel="time [s]", ylabel="power [W]", ylim=(min(0.0, axes.get_ylim()[0]), None))
        axes.legend()


def _coloured(axes: Axes, poses: FloatArray, commands: FloatArray, sharpest: float) -> LineCollection:
    """The way, each sample by its commanded radius; straight on counts as wide."""
    v, omega = np.abs(commands.T)
    radius = np.clip(v / np.maximum(omega, 1e-9), 0.8 * sharpest, _WIDEST)
    points = np.stack([poses[:-1, :2], poses[1:, :2]], axis=1)
    norm = LogNorm(0.8 * sharpest, max(_WIDEST, 2 * sharpest))
    lines = LineCollection(list(points), cmap="viridis", norm=norm, linewidth=2.5, zorder=3)
    lines.set_array(radius)
    axes.add_collection(lines)
    return lines
