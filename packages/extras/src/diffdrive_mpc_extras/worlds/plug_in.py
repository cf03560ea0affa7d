"""Plants in a world, named "world:NAME" or "world:NAME@PLANT", and the additional results of a run in a world."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.mpc import Trajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.sim import Plant, Run, make_plant
from diffdrive_mpc.sim.plants.make import plant_body
from diffdrive_mpc.sim.plants.names import split_plant
from diffdrive_mpc.sim.plants.plug_ins import PlantKind, RunColumns
from diffdrive_mpc.sim.plants.twin_parameters import TwinParameters
from diffdrive_mpc_extras.worlds.passage import Passage, passage_of
from diffdrive_mpc_extras.worlds.scene import WorldScene
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.world import load_world
from diffdrive_mpc_extras.worlds.world_plant import WorldPlant, WorldRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

    from diffdrive_mpc.bench.table import Table


def outline(robot: Robot, twin: TwinParameters) -> tuple[float, float]:
    """Return length and width of the rectangle around body and wheels in the top view [m]."""
    length, width, _ = twin.chassis.body_size
    return (
        max(length, twin.chassis.wheel_base + 2 * robot.wheel_radius),
        max(width, robot.track + world_settings().body.tyre_width),
    )


def plant_outline(name: str) -> tuple[float, float]:
    """Return length and width [m] of a plant's robot; "model:NAME" has the size of the papers' robot.

    Raises ConfigError if the robot file in the name is invalid.
    """
    return outline(*plant_body(name))


class WorldKind:
    """Plant kind of robots among obstacles and persons in MuJoCo."""

    def make_plant(self, name: str, plant: str, *, seed: int, **options: Any) -> Plant:  # noqa: ANN401
        """Make a plant in the named world; raises ConfigError if the world or the plant is invalid."""
        scene = WorldScene(load_world(name, seed), *plant_outline(plant))
        return WorldPlant(make_plant(plant, seed=seed, scene=scene, **options), scene, seed)

    def settings(self, name: str, plant: str) -> Mapping[str, object]:
        """Return the settings that enable `free_space` with the footprint of the robot."""
        del name
        length, width = plant_outline(plant)
        corners = [[x * length / 2, y * width / 2] for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        return {"free_space.enabled": True, "free_space.footprint": json.dumps(corners)}

    def reference(self, name: str, seed: int, limits: TrajectoryLimits) -> Trajectory | None:
        """Return the path through the world; None if the file of the world defines no path."""
        path = load_world(name, seed).way
        if path is None:
            return None
        from diffdrive_mpc.bench.case import label  # noqa: PLC0415 - only runs along the path need it
        from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints  # noqa: PLC0415 - loads SciPy

        return time_waypoints(path.waypoints, limits, name=label(name), speed=path.speed, timing="smooth")


class WorldColumns(RunColumns):
    """Columns, summary, table and drawing of runs in a world."""

    def row(self, run: Run) -> Mapping[str, object]:
        """Return the fields of `Passage` as `passage_*`."""
        return {f"passage_{name}": value for name, value in asdict(passage(run)).items()}

    def summary(self, run: Run) -> str:
        """Return arrival, contacts and clearance in one line."""
        result = passage(run)
        arrived = "arrived" if result.arrived else "not arrived"
        return f"world: {arrived}, {result.contacts} contacts, minimum clearance {result.clearance_m:.3f} m"

    def table(self, rows: DataFrame) -> Table:
        """Return the table of results by plant and controller."""
        from diffdrive_mpc_extras.worlds.drawing import world_table  # noqa: PLC0415 - a run without report needs none

        return world_table(rows)

    def draw(self, axes: Axes, run: Run) -> None:
        """Draw obstacles and persons."""
        from diffdrive_mpc_extras.worlds.drawing import draw_world  # noqa: PLC0415 - loads matplotlib

        draw_world(axes, world_record(run).world)


def split(plant: str) -> tuple[PlantKind, str, str]:
    """Split the name of a plant in a world into its kind, the world and the plant inside; raises ConfigError."""
    parts = split_plant(plant)
    if parts is None:
        raise ConfigError(f"plant '{plant}' is not in a world; use world:NAME or world:NAME@PLANT")
    return parts


def world_record(run: Run) -> WorldRecord:
    """Return the record of a run in a world; raises KeyError for other runs."""
    record: WorldRecord = run.parts["world"]
    return record


def passage(run: Run) -> Passage:
    """Evaluate a run in a world; raises KeyError for other runs."""
    record = world_record(run)
    goal = run.reference.sample([run.reference.duration]).pose[0]
    return passage_of(record.world, record.outline, record.contacts, goal, run.time, run.true_pose, run.true_twist)


WORLD, COLUMNS = WorldKind(), WorldColumns()
