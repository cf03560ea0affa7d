"""The figure of turn costs from a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc_extras.costs_from_log.costs_from_log import LogOutcome
from diffdrive_mpc_extras.turn_costs import Vehicle

_RADII = np.geomspace(0.3, 300.0, 80)


def draw_log(outcome: LogOutcome, path: Path) -> None:
    """Torques by the currents of a log, and the curves learned from them."""
    with new_figure(path, 6.4, 3.8) as figure:
        axes = figure.subplots()
        radii, outer, inner = outcome.samples.T
        pairs = ((outer, outcome.curves.outer, "outer"), (inner, outcome.curves.inner, "inner"))
        for side, (values, prior, name) in enumerate(pairs):
            axes.plot(radii, values, ".", color=colour(side), markersize=1.5, alpha=0.25, rasterized=True)
            axes.plot(_RADII, prior(_RADII), color=colour(side), label=name)
        least = outcome.curves.least_radius()
        if 0 < least < np.inf:
            axes.axvline(least, color=colour(2), linestyle="-.", label=f"least radius {least:.2f} m")
        torque_axes(axes, outcome.vehicle, f"Torques by the motors' currents in {outcome.log.name}")
        axes.legend()


def torque_axes(axes: Axes, vehicle: Vehicle, title: str) -> None:
    """Label the axes of torques over radii, and draw the limits of the motors."""
    for sign in (1, -1):
        axes.axhline(sign * vehicle.torque_limit, color=REFERENCE_COLOUR, linewidth=0.8, linestyle="--")
    axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
    axes.set(xscale="log", xlabel="commanded turn radius [m]", ylabel="torque [N m]", title=title)
