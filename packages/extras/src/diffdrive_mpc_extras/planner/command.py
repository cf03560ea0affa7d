"""Command `diffdrive-mpc plan`: plan a reference from pose to pose with minimum energy, time or distance."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import PluggedCommand, file_option, out_option


def plan(
    *,
    start: Annotated[str, typer.Option("--from", metavar="X,Y,DEG", help="Start pose [m, m, degrees].")],
    end: Annotated[str, typer.Option("--to", metavar="X,Y,DEG", help="Goal pose [m, m, degrees].")],
    out: Annotated[Path, out_option("trajectory.csv, report.html, plan.json, plan.md and figures/")],
    costs: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Motion and cost of turns on the surface (YAML), as written by `torque`.",
        ),
    ] = "fsu_bot-default",
    via: Annotated[list[str] | None, typer.Option(metavar="X,Y", help="Via point [m]; repeatable, in order.")] = None,
    minimise: Annotated[str, typer.Option(metavar="energy|time|distance", help="Objective.")] = "energy",
    speed: Annotated[
        float | None,
        typer.Option(help="Speed on straights and wide turns [m/s].", show_default="that of the torque table"),
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="World with obstacles (YAML)."),
    ] = None,
    reverse: Annotated[bool, typer.Option("--reverse", help="Allow driving backwards.")] = False,
    on_the_spot: Annotated[bool, typer.Option("--on-the-spot", help="Allow turns on the spot.")] = False,
    margin: Annotated[
        float | None,
        typer.Option(min=0.0, help="Margin between robot and obstacles [m].", show_default="that of the settings"),
    ] = None,
    idle_power: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            metavar="W",
            help="Power of computer, sensors and motor drivers during the drive [W].",
            show_default="that of the costs",
        ),
    ] = None,
    settings: Annotated[Path | None, file_option("Settings of the planner", "--settings")] = None,
) -> None:
    """Plan a timed reference with slip, torque and minimum radius of a surface; takes seconds."""
    import numpy as np  # noqa: PLC0415 - --help does not need it

    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415
    from diffdrive_mpc_extras.planner.clearance import PlanError  # noqa: PLC0415
    from diffdrive_mpc_extras.planner.inputs import OBJECTIVES  # noqa: PLC0415
    from diffdrive_mpc_extras.planner.settings import load_plan_settings  # noqa: PLC0415
    from diffdrive_mpc_extras.planner.study import PlanRequest, PlanStudy  # noqa: PLC0415
    from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415
    from diffdrive_mpc_extras.worlds.world import load_world  # noqa: PLC0415

    objective = next((word for word in OBJECTIVES if word == minimise), None)
    if objective is None:
        raise PlanError(f"--minimise '{minimise}': give {', '.join(OBJECTIVES[:-1])} or {OBJECTIVES[-1]}")
    turn_costs, plan_settings = load_turn_costs(costs), load_plan_settings(settings)
    if idle_power is not None:
        turn_costs = turn_costs.with_idle_power(idle_power)
    if margin is not None:
        plan_settings = plan_settings.model_copy(
            update={"motion": plan_settings.motion.model_copy(update={"margin": margin})}
        )
    carry_out(
        PlanStudy(
            PlanRequest(
                costs=turn_costs,
                start=np.array(_pose(start, "--from")),
                goal=np.array(_pose(end, "--to")),
                via=np.array([_numbers(word, 2, "--via", "X,Y") for word in via or ()]).reshape(-1, 2),
                minimise=objective,
                speed=turn_costs.curve.speed if speed is None else speed,
                world=None if world is None else load_world(world),
                reverse=reverse,
                on_the_spot=on_the_spot,
                settings=plan_settings,
            )
        ),
        out,
        jobs=1,
    )


PLAN = PluggedCommand(
    "Files",
    plan,
    "Example: diffdrive-mpc plan --costs fsu_bot-default --from 0,0,0 --to 8,5,0 --minimise energy --out plan",
)


def _pose(text: str, option: str) -> tuple[float, float, float]:
    x, y, degrees = _numbers(text, 3, option, "X,Y,DEG")
    return x, y, math.radians(degrees)


def _numbers(text: str, count: int, option: str, form: str) -> list[float]:
    """Parse numbers separated by commas; raises typer.BadParameter for any other text."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise typer.BadParameter(f"'{text}': give {form}, {count} numbers with commas between", param_hint=option)
    return values
