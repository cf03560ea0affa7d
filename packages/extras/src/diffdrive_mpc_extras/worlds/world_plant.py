"""A plant in a world: a contact ends the run, and the controller receives what the robot observes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement, TrackingController
from diffdrive_mpc.sim.disturbances.disturbance_types import Span
from diffdrive_mpc.sim.plants.disturbed_plant import DisturbedPlant
from diffdrive_mpc.sim.plants.plant import Plant, PlantAround, RobotLostError
from diffdrive_mpc_extras.worlds.passage import Contact
from diffdrive_mpc_extras.worlds.scene import WorldScene
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.sight import Eyes, Seen
from diffdrive_mpc_extras.worlds.world import World


class TouchedError(RobotLostError):
    """The robot touched something, which ends the run according to the world's file."""


@dataclass(frozen=True)
class WorldRecord:
    """World of a run.

    Attributes
    ----------
    world
        Obstacles and persons.
    contacts
        Contacts of the robot with them.
    outline
        Length and width of the robot [m].
    """

    world: World
    contacts: tuple[Contact, ...]
    outline: tuple[float, float]


class WorldPlant(PlantAround):
    """The physics in a world; see `sim.plants.plant.Plant`.

    Parameters
    ----------
    plant
        The physics, perhaps with a scenario around it.
    scene
        The world in it.
    seed
        Seed of the noise of the sensors.
    """

    def __init__(self, plant: Plant, scene: WorldScene, seed: int) -> None:
        super().__init__(plant)
        self._scene = scene
        self._rules = world_settings()
        self._eyes = Eyes(scene.world, seed)
        self._moved_at = 0.0
        self._observer: tuple[TrackingController, Callable[[Seen], None] | None] | None = None

    @property
    def world(self) -> World:
        """Return the world."""
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
        """Return the disturbance of the plant inside."""
        return self._plant.disturbance if isinstance(self._plant, DisturbedPlant) else None

    base_topics = ("scan",)
    """Topics of the simulated base for this plant, see `sim.ros.simulated_base.BaseTopics`."""

    @property
    def time_limit(self) -> float:
        """Latest time of the robot's arrival [s]."""
        return self.world.time_limit

    @property
    def records(self) -> Mapping[str, object]:
        """Record of the world, and those of the plant inside."""
        return {**super().records, "world": WorldRecord(self.world, self.contacts, self.footprint)}

    def show(self, controller: TrackingController) -> None:
        """Pass the newest observation, if any, to a peer's `set_obstacles` or to the feature `free_space`."""
        sighting = self.look()
        if self._observer is None or self._observer[0] is not controller:
            self._observer = controller, _observer_of(controller)
        observe = self._observer[1]
        if sighting is not None and observe is not None:
            observe(sighting)

    def is_over(self, goal: FloatArray) -> bool:
        """Return True if the robot stands at `goal`, a pose (3,), or has stood too long in unchanged surroundings."""
        stood = self.time - self._moved_at
        return self._arrived(goal) or (not self.world.changes and stood > self._rules.goal.give_up)

    def _arrived(self, goal: FloatArray) -> bool:
        x, y, _ = goal
        (here_x, here_y, _), (v, lateral, _) = self.true_pose, self.true_twist
        near = math.hypot(here_x - x, here_y - y) <= self._rules.goal.distance
        return bool(near) and math.hypot(v, lateral) <= self._rules.goal.speed

    def look(self) -> Seen | None:
        """Return the sighting that has arrived by now; None without a new one. Call it once a tick."""
        return self._eyes.look(self.time, self.true_pose)

    def reset(self, pose: ArrayLike) -> None:
        """Reset the plant inside, sight and contacts."""
        self._plant.reset(pose)
        self._eyes.reset()
        self._moved_at = 0.0

    def measure(self) -> Measurement:
        """Measure as the plant inside."""
        return self._plant.measure()

    def advance(self, command: ArrayLike) -> None:
        """Advance the plant inside; raise TouchedError for a collision that ends the run."""
        self._plant.advance(command)
        if math.hypot(*self.true_twist) > self._rules.contact.moving_speed:
            self._moved_at = self.time
        if self.world.ends_at_contact:
            moving = [contact for contact in self.contacts if contact.fastest > self._rules.contact.moving_speed]
            if moving:
                raise TouchedError(moving[0].sentence)


def _observer_of(controller: TrackingController) -> Callable[[Seen], None] | None:
    """Return the method that takes observations; None for a controller without one."""
    feature = getattr(controller, "feature", None)
    owner = controller if feature is None or hasattr(controller, "set_obstacles") else feature("free_space")
    observe: Callable[[Seen], None] | None = getattr(owner, "set_obstacles", None)
    return observe
