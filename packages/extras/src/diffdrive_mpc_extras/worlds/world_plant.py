"""A plant in a world: what it touches ends the run, what it sees is handed out, and when it has arrived is known."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.sim.disturbances.disturbance_types import Span
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.plant import Plant, PlantAround, RobotLostError
from diffdrive_mpc_extras.worlds.passage import Contact
from diffdrive_mpc_extras.worlds.scene import WorldScene
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.sight import Eyes, Seen
from diffdrive_mpc_extras.worlds.world import World


class TouchedError(RobotLostError):
    """The robot touched something, and the world's file says that this ends the run."""


class WorldPlant(PlantAround):
    """The physics in a world; see `sim.plants.plant.Plant`.

    Parameters
    ----------
    plant
        The physics, perhaps with a scenario around it.
    scene
        The world in it.
    seed
        Of the noise of what is seen.
    """

    def __init__(self, plant: Plant, scene: WorldScene, seed: int) -> None:
        super().__init__(plant)
        self._scene = scene
        self._rules = world_settings()
        self._eyes = Eyes(scene.world, seed)
        self._moved_at = 0.0

    @property
    def world(self) -> World:
        """What there is."""
        return self._scene.world

    @property
    def footprint(self) -> tuple[float, float]:
        """Length and width of the hull, whose middle is the base point [m]."""
        return self._scene.length, self._scene.width

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Everything touched since the last reset."""
        return self._scene.log.events

    @property
    def disturbance(self) -> Span | None:
        """As of the plant inside."""
        return self._plant.disturbance if isinstance(self._plant, DisturbedPlant) else None

    def over(self, goal: FloatArray) -> bool:
        """Whether the robot stands at `goal`, a pose (3,), or has stood so long that nothing will come any more."""
        stood = self.time - self._moved_at
        return self._arrived(goal) or (not self.world.changes and stood > self._rules.goal.give_up)

    def _arrived(self, goal: FloatArray) -> bool:
        x, y, _ = goal
        (here_x, here_y, _), (v, lateral, _) = self.true_pose, self.true_twist
        near = math.hypot(here_x - x, here_y - y) <= self._rules.goal.distance
        return bool(near) and math.hypot(v, lateral) <= self._rules.goal.speed

    def look(self) -> Seen | None:
        """What was seen and has arrived by now; None for nothing new. To be called once a tick."""
        return self._eyes.look(self.time, self.true_pose)

    def reset(self, pose: ArrayLike) -> None:
        """As the plant inside; eyes and contacts begin anew."""
        self._plant.reset(pose)
        self._eyes.reset()
        self._moved_at = 0.0

    def measure(self) -> Measurement:
        """As the plant inside."""
        return self._plant.measure()

    def advance(self, command: ArrayLike) -> None:
        """As the plant inside; raises TouchedError where the robot moved onto something and that ends the run."""
        self._plant.advance(command)
        if math.hypot(*self.true_twist) > self._rules.contact.moving_speed:
            self._moved_at = self.time
        if self.world.ends_at_contact:
            moving = [contact for contact in self.contacts if contact.fastest > self._rules.contact.moving_speed]
            if moving:
                raise TouchedError(moving[0].sentence)
