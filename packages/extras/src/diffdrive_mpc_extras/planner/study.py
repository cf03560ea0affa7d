"""Study of a plan for one objective, in comparison with the plans for the other objectives."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.patches import Polygon

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.page import KeyFigure, PageContents, PageWarning
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.free_space import MovingDisc, Surroundings
from diffdrive_mpc_extras.planner.clearance import outline
from diffdrive_mpc_extras.planner.inputs import Objective
from diffdrive_mpc_extras.planner.planner import plan_each
from diffdrive_mpc_extras.planner.result import Plan
from diffdrive_mpc_extras.planner.settings import PlanSettings
from diffdrive_mpc_extras.turn_costs import TurnCosts
from diffdrive_mpc_extras.worlds.drawing import draw_world
from diffdrive_mpc_extras.worlds.world import World

# A note is given where the way of least energy is longer than the shortest by this factor.
_LONG = 1.5


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """Request for a plan.

    Attributes
    ----------
    costs
        Motion and cost of the robot on its surface.
    start, goal
        (3,) poses x, y [m], theta [rad].
    via
        (n, 2) via points [m].
    minimise
        Quantity to minimise.
    speed
        Speed [m/s].
    world
        World at the start; moving objects are ignored.
    reverse, on_the_spot
        True to allow driving backwards and turns on the spot.
    settings
        Settings of the planner.
    """

    costs: TurnCosts
    start: FloatArray
    goal: FloatArray
    via: FloatArray
    minimise: Objective
    speed: float
    world: World | None
    reverse: bool
    on_the_spot: bool
    settings: PlanSettings

    @property
    def surroundings(self) -> Surroundings | None:
        """Surroundings of the robot in the world."""
        if self.world is None:
            return None
        shapes = self.world.shapes(0.0)
        return Surroundings(polygons=shapes.polygons, discs=[MovingDisc(*disc) for disc in shapes.discs.tolist()])


Plans = dict[Objective, Plan]


class PlanStudy(Study[PlanRequest, Plans]):
    """Study of the plans for all objectives, with the trajectory of the requested one.

    Parameters
    ----------
    request
        Request for the plan.
    """

    name = "plan"
    title = "Optimal reference"

    def __init__(self, request: PlanRequest) -> None:
        self._request, self._seconds = request, 0.0

    def plan(self) -> PlanRequest:
        """Return the request; `run` reports impossible plans before anything is written."""
        return self._request

    def run(self, plan: PlanRequest, jobs: int, bar: ProgressBar) -> Plans:  # noqa: ARG002 - single task
        """Compute the plans; raises PlanError if there is no path."""
        bar.start_stage("planning", 1)
        start_time = time.process_time()
        plans = plan_each(
            plan.costs,
            plan.start,
            plan.goal,
            plan.via,
            speed=plan.speed,
            obstacles=plan.surroundings,
            reverse=plan.reverse,
            on_the_spot=plan.on_the_spot,
            settings=plan.settings,
        )
        self._seconds = time.process_time() - start_time
        bar.advance()
        return plans

    def report(self, results: Plans, seconds: float) -> Report:  # noqa: ARG002 - processor time instead
        """Return the report with tables, figures and the trajectory."""
        request, selected = self._request, results[self._request.minimise]
        return Report(
            size=f"{len(results)} plans",
            meta={
                "costs": request.costs.name,
                "provenance": request.costs.provenance,
                "speed_m_s": request.speed,
                "minimise": request.minimise,
                "from": request.start.tolist(),
                "to": request.goal.tolist(),
                "via": request.via.tolist(),
            },
            content={"plans": [_row(plan) for plan in results.values()], "pieces": _pieces(selected)},
            facts=[
                f"'{request.costs.name}' at {request.speed:g} m/s, minimum radius {_radius(request)}; "
                f"minimum radius of the plan {selected.sharpest:.2f} m (commanded).",
                f"trajectory.csv minimises {request.minimise}: {number(selected.energy, 1)} J predicted, "
                f"{number(selected.duration, 1)} s, {number(selected.length, 2)} m.",
                f"Search: {selected.search.states} states, cost {number(selected.search.cost, 2)} without ramps, bound "
                f"{number(selected.search.bound, 2)}; polish: {selected.status} ({selected.solver}).",
                f"{number(self._seconds, 2)} s of processor time for all objectives.",
            ],
            notes=[
                "Energy is that of the commands of the timed reference by torque table, slip law and drive constants, "
                "without the energy for acceleration.",
                *(
                    []
                    if selected.search.complete
                    else ["The search reached its maximum number of states: a better path may exist."]
                ),
            ],
            tables=[_table(results, request.minimise)],
            figures={
                "paths.png": partial(draw_paths, request, results),
                "power.png": partial(draw_power, request, results),
            },
            shown=PageContents(
                key_figures=_key_figures(results, request.minimise), warnings=_warnings(request, results)
            ),
            files={"trajectory.csv": trajectory_text(selected)},
        )


def trajectory_text(plan: Plan) -> str:
    """Format timed poses for `load_trajectory`."""
    rows = [",".join(f"{value:.9g}" for value in row) for row in plan.rows.tolist()]
    return "\n".join(["t,x,y,theta", *rows]) + "\n"


def saving(results: Plans) -> float:
    """Compute the relative energy saving of the energy-optimal over the distance-optimal plan [-]."""
    return 1 - results["energy"].energy / results["distance"].energy


def _warnings(request: PlanRequest, results: Plans) -> list[PageWarning]:
    """Warn about long paths, whose duration has no cost if the idle power is zero."""
    cheapest, shortest = results["energy"].length, results["distance"].length
    if request.minimise != "energy" or request.costs.drive.idle_power > 0 or cheapest < _LONG * shortest:
        return []
    return [
        PageWarning(
            f"The minimum-energy path is {cheapest / shortest:.1f} times as long as the shortest path, because the "
            "drive constants contain no idle power.",
            "Set the power of computer and sensors: --idle-power, or idle_power in the costs.",
        )
    ]


def _key_figures(results: Plans, minimise: Objective) -> list[KeyFigure]:
    selected = results[minimise]
    return [
        KeyFigure("energy", f"{number(selected.energy, 1)} J", f"predicted, of the {minimise}-optimal plan"),
        KeyFigure("duration", f"{number(selected.duration, 1)} s"),
        KeyFigure("length", f"{number(selected.length, 2)} m"),
        KeyFigure("saved", f"{number(100 * saving(results), 1)} %", "energy, compared with the distance-optimal plan"),
    ]


def _table(results: Plans, minimise: Objective) -> Table:
    return Table.build(
        "Plans",
        ("optimal in",),
        {
            "energy [J]": lambda row: number(row.energy, 1),
            "time [s]": lambda row: number(row.duration, 1),
            "length [m]": lambda row: number(row.length, 2),
            "sharpest turn [m]": lambda row: number(_sharpest(row), 2),
            "method": lambda row: row.status,
        },
        [((f"{name}, written" if name == minimise else name,), result) for name, result in results.items()],
    )


def _sharpest(plan: Plan) -> float:
    """Compute the minimum commanded radius above half of the speed [m]."""
    v, omega = np.abs(plan.commands.T)
    moving = v > 0.5 * v.max()
    return float((v[moving] / np.maximum(omega[moving], 1e-6)).min())


def _radius(request: PlanRequest) -> str:
    radius = request.costs.least_radius(request.speed)
    return "none" if radius == 0 else f"{radius:.2f} m"


def _row(plan: Plan) -> dict[str, object]:
    return {
        "minimise": plan.minimise,
        "energy_j": plan.energy,
        "duration_s": plan.duration,
        "length_m": plan.length,
        "sharpest_m": plan.sharpest,
        "clearance_m": plan.clearance if math.isfinite(plan.clearance) else None,
        "search_cost": plan.search.cost,
        "search_bound": plan.search.bound,
        "search_states": plan.search.states,
        "search_complete": plan.search.complete,
        "status": plan.status,
        "solver": plan.solver,
    }


def _pieces(plan: Plan) -> list[dict[str, object]]:
    return [
        {"v_m_s": piece.v, "omega_rad_s": piece.omega, "duration_s": piece.duration, "leg": piece.leg}
        for piece in plan.pieces
    ]


_MAX_RADIUS = 50.0
_OUTLINES = 12


def draw_paths(request: PlanRequest, plans: Plans, path: Path) -> None:
    """Draw the selected path by commanded radius with the robot along it, and the other paths dashed."""
    selected = plans[request.minimise]
    with new_figure(path, 6.4, 5.2) as figure:
        axes = figure.subplots()
        if request.world is not None:
            draw_world(axes, request.world)
        for k, (name, plan) in enumerate(plans.items()):
            if name != request.minimise:
                label = f"{name}: {plan.energy:.0f} J, {plan.length:.1f} m"
                axes.plot(plan.poses[:, 0], plan.poses[:, 1], "--", color=colour(k + 1), label=label)
        lines = _draw_coloured(axes, selected.poses, selected.commands, selected.sharpest)
        axes.plot(
            [], [], color=colour(0), label=f"{request.minimise}: {selected.energy:.0f} J, {selected.length:.1f} m"
        )
        corners = outline(request.costs.vehicle).corners
        for x, y, theta in selected.poses[np.linspace(0, len(selected.poses) - 1, _OUTLINES).astype(int)].tolist():
            c, s = np.cos(theta), np.sin(theta)
            moved_corners = corners @ np.array([[c, s], [-s, c]]) + (x, y)
            axes.add_patch(Polygon(moved_corners, fill=False, edgecolor=REFERENCE_COLOUR, linewidth=0.6))
        if len(request.via):
            axes.plot(*request.via.T, "x", color=REFERENCE_COLOUR, label="via")
        figure.colorbar(lines, ax=axes, label="commanded radius [m]", shrink=0.8)
        axes.set(
            xlabel="x [m]",
            ylabel="y [m]",
            aspect="equal",
            title=f"Minimum {request.minimise} on '{request.costs.name}'",
        )
        axes.margins(0.08)
        axes.legend(loc="best")


def draw_power(request: PlanRequest, plans: Plans, path: Path) -> None:
    """Draw the predicted power of all plans over time."""
    with new_figure(path, 6.4, 3.2) as figure:
        axes = figure.subplots()
        for k, (name, plan) in enumerate(plans.items()):
            times = plan.sample_time * np.arange(len(plan.power))
            style = "-" if name == request.minimise else line_style(k + 1)
            axes.plot(times, plan.power, style, color=colour(k), label=f"{name}, {plan.energy:.0f} J")
        axes.set(xlabel="time [s]", ylabel="power [W]", ylim=(min(0.0, axes.get_ylim()[0]), None))
        axes.legend()


def _draw_coloured(axes: Axes, poses: FloatArray, commands: FloatArray, sharpest: float) -> LineCollection:
    """Draw the path coloured by the commanded radius, clipped for straight motion."""
    v, omega = np.abs(commands.T)
    radius = np.clip(v / np.maximum(omega, 1e-9), 0.8 * sharpest, _MAX_RADIUS)
    points = np.stack([poses[:-1, :2], poses[1:, :2]], axis=1)
    norm = LogNorm(0.8 * sharpest, max(_MAX_RADIUS, 2 * sharpest))
    lines = LineCollection(list(points), cmap="viridis", norm=norm, linewidth=2.5, zorder=3)
    lines.set_array(radius)
    axes.add_collection(lines)
    return lines
