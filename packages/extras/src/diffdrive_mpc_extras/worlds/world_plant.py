"""Plant in a world: a contact ends the run, and the controller receives the detected obstacles."""

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
from diffdrive_mpc_extras.worlds.sight import Observation, ObstacleSensors
from diffdrive_mpc_extras.worlds.world import World


class ContactError(RobotLostError):
    """Contact of the moving robot with an obstacle, which ends the run in this world."""


@dataclass(frozen=True)
class WorldRecord:
    """World and contacts of a run.

    Attributes
    ----------
    world
        Obstacles and persons.
    contacts
        Contacts of the robot with obstacles and persons.
    outline
        Length and width of the robot [m].
    """

    world: World
    contacts: tuple[Contact, ...]
    outline: tuple[float, float]


class WorldPlant(PlantAround):
    """MuJoCo plant in a world; see `sim.plants.plant.Plant`.

    Parameters
    ----------
    plant
        MuJoCo plant, with or without a scenario.
    scene
        Obstacles that were added to the model of the plant.
    seed
        Seed of the noise of the obstacle sensors.
    """

    def __init__(self, plant: Plant, scene: WorldScene, seed: int) -> None:
        super().__init__(plant)
        self._scene = scene
        self._settings = world_settings()
        self._sensors = ObstacleSensors(scene.world, seed)
        self._last_motion_time = 0.0
        self._receiver: tuple[TrackingController, Callable[[Observation], None] | None] | None = None

    @property
    def world(self) -> World:
        """World around the robot."""
        return self._scene.world

    @property
    def footprint(self) -> tuple[float, float]:
        """Length and width of the hull, centred on the base point [m]."""
        return self._scene.length, self._scene.width

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts since the last reset."""
        return self._scene.log.events

    @property
    def disturbance(self) -> Span | None:
        """Disturbance of the inner plant; None without a scenario."""
        return self._plant.disturbance if isinstance(self._plant, DisturbedPlant) else None

    base_topics = ("scan",)
    """Additional topics of the simulated base, see `sim.ros.simulated_base.BaseTopics`."""

    @property
    def time_limit(self) -> float:
        """Time limit of the arrival [s]."""
        return self.world.time_limit

    @property
    def records(self) -> Mapping[str, object]:
        """Records of the inner plant and of the world."""
        return {**super().records, "world": WorldRecord(self.world, self.contacts, self.footprint)}

    def show(self, controller: TrackingController) -> None:
        """Pass a new observation to `set_obstacles` of a peer or of the feature `free_space`."""
        observation = self.look()
        if self._receiver is None or self._receiver[0] is not controller:
            self._receiver = controller, _obstacle_setter(controller)
        set_obstacles = self._receiver[1]
        if observation is not None and set_obstacles is not None:
            set_obstacles(observation)

    def is_over(self, goal: FloatArray) -> bool:
        """Return True on arrival at `goal`, a pose (3,), or after a long standstill in a world without changes."""
        standstill = self.time - self._last_motion_time
        return self._has_arrived(goal) or (not self.world.changes and standstill > self._settings.goal.give_up)

    def _has_arrived(self, goal: FloatArray) -> bool:
        goal_x, goal_y, _ = goal
        (x, y, _), (v, lateral, _) = self.true_pose, self.true_twist
        is_near = math.hypot(x - goal_x, y - goal_y) <= self._settings.goal.distance
        return bool(is_near) and math.hypot(v, lateral) <= self._settings.goal.speed

    def look(self) -> Observation | None:
        """Return the newest observation; None if none arrived since the last call. Call it once per tick."""
        return self._sensors.observe(self.time, self.true_pose)

    def reset(self, pose: ArrayLike) -> None:
        """Reset inner plant, obstacle sensors and contacts."""
        self._plant.reset(pose)
        self._sensors.reset()
        self._last_motion_time = 0.0

    def measure(self) -> Measurement:
        """Return the measurement of the inner plant."""
        return self._plant.measure()

    def advance(self, command: ArrayLike) -> None:
        """Advance the inner plant; raise ContactError for a contact that ends the run."""
        self._plant.advance(command)
        if math.hypot(*self.true_twist) > self._settings.contact.moving_speed:
            self._last_motion_time = self.time
        if self.world.ends_at_contact:
            moving = [contact for contact in self.contacts if contact.max_speed > self._settings.contact.moving_speed]
            if moving:
                raise ContactError(moving[0].sentence)


def _obstacle_setter(controller: TrackingController) -> Callable[[Observation], None] | None:
    """Return the method `set_obstacles` of a controller or its feature `free_space`; None without such a method."""
    feature = getattr(controller, "feature", None)
    owner = controller if feature is None or hasattr(controller, "set_obstacles") else feature("free_space")
    setter: Callable[[Observation], None] | None = getattr(owner, "set_obstacles", None)
    return setter
