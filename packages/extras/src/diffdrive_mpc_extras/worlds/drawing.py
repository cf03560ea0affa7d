"""Top view of a world in Matplotlib axes, and the table of passages."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Circle
from matplotlib.patches import Polygon as Patch
from pandas import DataFrame

from diffdrive_mpc.bench.case import label
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc_extras.worlds.world import World

_STATIC_COLOUR, _MOVING_COLOUR = "#555555", "#E69F00"


def draw_world(axes: Axes, world: World) -> None:
    """Draw the obstacles at the start of a run, and each mover with an arrow along its velocity."""
    shapes = world.shapes(0.0)
    for corners in shapes.polygons:
        axes.add_patch(Patch(corners, facecolor=_STATIC_COLOUR, edgecolor="none"))
    for x, y, radius in shapes.discs:
        axes.add_patch(Circle((x, y), radius, facecolor=_STATIC_COLOUR, edgecolor="none"))
    for mover in world.movers:
        position, velocity = mover.position(mover.time), mover.velocity
        axes.add_patch(Circle(tuple(position), mover.radius, facecolor=_MOVING_COLOUR, alpha=0.6))
        arrow = {"arrowstyle": "->", "color": _MOVING_COLOUR}
        axes.annotate("", tuple(position + velocity), tuple(position - velocity), arrowprops=arrow)
    axes.autoscale_view()


_NOTE = (
    "Contacts: obstacles that the moving hull touched in MuJoCo. Walked into: persons who touched the standing hull. "
    "Clearance: distance from the hull to the nearest obstacle."
)


def world_table(rows: DataFrame) -> Table:
    """Return the table with one row per plant and controller; `rows` have the columns `passage_*`."""
    groups = rows.groupby(["plant", "driver"], sort=False)
    entries = [((label(plant), driver), group) for (plant, driver), group in groups]
    columns = {
        "arrived": lambda group: "yes" if group["passage_arrived"].all() else "no",
        "time [s]": lambda group: number(group["passage_time_s"].mean(skipna=False), 1),
        "contacts": lambda group: number(group["passage_contacts"].sum(), 0),
        "contact speed [m/s]": lambda group: number(group["passage_contact_speed_m_s"].mean(skipna=False), 2),
        "walked into": lambda group: number(group["passage_walked_into"].sum(), 0),
        "minimum clearance [m]": lambda group: number(group["passage_clearance_m"].mean(skipna=False), 3),
        "standstill [s]": lambda group: number(group["passage_standing_s"].mean(skipna=False), 1),
    }
    return Table.build("World", ("plant", "controller"), columns, entries, _NOTE)
