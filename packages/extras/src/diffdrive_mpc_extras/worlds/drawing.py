"""Worlds from above, in axes of matplotlib."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Circle
from matplotlib.patches import Polygon as Patch

from diffdrive_mpc_extras.worlds.world import World

_STANDS, _MOVES = "#555555", "#E69F00"


def draw_world(axes: Axes, world: World) -> None:
    """Draw the obstacles at the start of a run, and an arrow for each person from its first place."""
    shapes = world.shapes(0.0)
    for corners in shapes.polygons:
        axes.add_patch(Patch(corners, facecolor=_STANDS, edgecolor="none"))
    for x, y, radius in shapes.discs:
        axes.add_patch(Circle((x, y), radius, facecolor=_STANDS, edgecolor="none"))
    for mover in world.movers:
        place, step = mover.position(mover.time), mover.velocity
        axes.add_patch(Circle(tuple(place), mover.radius, facecolor=_MOVES, alpha=0.6))
        axes.annotate("", tuple(place + step), tuple(place - step), arrowprops={"arrowstyle": "->", "color": _MOVES})
    axes.autoscale_view()
