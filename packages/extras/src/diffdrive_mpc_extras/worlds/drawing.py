"""Worlds from above, in axes of matplotlib."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Circle
from matplotlib.patches import Polygon as Patch
from pandas import DataFrame

from diffdrive_mpc.bench.case import label
from diffdrive_mpc.bench.table import Table, number
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


_NOTE = (
    "Contacts: MuJoCo's, of the robot's hull while it moves. Walked into: by persons while it stands. "
    "Clearance: of the hull from anything."
)


def world_table(rows: DataFrame) -> Table:
    """Return one row per plant and controller; `rows` have the columns `passage_*`."""
    groups = rows.groupby(["plant", "driver"], sort=False)
    entries = [((label(plant), driver), part) for (plant, driver), part in groups]
    columns = {
        "arrived": lambda part: "yes" if part["passage_arrived"].all() else "no",
        "time [s]": lambda part: number(part["passage_time_s"].mean(skipna=False), 1),
        "contacts": lambda part: number(part["passage_contacts"].sum(), 0),
        "contact speed [m/s]": lambda part: number(part["passage_contact_speed_m_s"].mean(skipna=False), 2),
        "walked into": lambda part: number(part["passage_walked_into"].sum(), 0),
        "least clearance [m]": lambda part: number(part["passage_clearance_m"].mean(skipna=False), 3),
        "stood [s]": lambda part: number(part["passage_standing_s"].mean(skipna=False), 1),
    }
    return Table.build("World", ("plant", "controller"), columns, entries, _NOTE)
