"""Outline of a robot from above."""

from __future__ import annotations

from diffdrive_mpc.models.robot import Robot
from diffdrive_mpc.sim.plants.make import plant_body
from diffdrive_mpc.sim.plants.twin_parameters import TwinParameters
from diffdrive_mpc_extras.worlds.settings import world_settings


def outline(robot: Robot, twin: TwinParameters) -> tuple[float, float]:
    """Return length and width of body and wheels from above [m]."""
    length, width, _ = twin.chassis.body_size
    return (
        max(length, twin.chassis.wheel_base + 2 * robot.wheel_radius),
        max(width, robot.track + world_settings().body.tyre_width),
    )


def plant_outline(name: str) -> tuple[float, float]:
    """Return length and width [m] of the robot of a plant's name, that of the papers for "model:NAME".

    Raises ConfigError if it names a robot file that cannot be used.
    """
    return outline(*plant_body(name))
