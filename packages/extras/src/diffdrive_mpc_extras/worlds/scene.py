"""World in MuJoCo: obstacles as geoms, movers as mocap bodies, and detection of contacts with the robot's hull."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.passage import ContactLog
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.world import World, is_present

HULL = "hull"
_OBSTACLE_BIT = 2
# Movers exert almost no force: a person who walks into a robot does not push it through a wall. This is the minimum
# impedance of MuJoCo with a long time constant.
_NEGLIGIBLE_FORCE = 'solref="1000 1" solimp="0.0001 0.0001 0.001" priority="1"'
_CLEARANCE = 0.02
"""Clearance of the hull above the ground [m]."""


class WorldScene:
    """Obstacles that a world adds to the MuJoCo model of the robot, and the contacts with them.

    Parameters
    ----------
    world
        The obstacles.
    length, width
        Length and width of the robot's hull [m].
    """

    def __init__(self, world: World, length: float, width: float) -> None:
        self.world, self.length, self.width = world, length, width
        self._rules = world_settings().contact
        self._height = world_settings().body.height
        self.log = ContactLog(self._rules.gap)

    @property
    def obstacles(self) -> str:
        """MJCF of all obstacles, for the element `worldbody`."""
        elements = [_prism(name, outline.corners, self._height) for name, outline in self.world.outlines]
        bits = f'contype="0" conaffinity="{_OBSTACLE_BIT}"'
        half = 0.5 * self._height
        elements += [
            f'<geom name="post {i}" type="cylinder" size="{post.radius!r} {half!r}" pos="{post.at[0]!r} {post.at[1]!r}'
            f' {half!r}" {bits}/>'
            for i, post in enumerate(self.world.posts)
        ]
        elements += [
            f'<body name="mover {i}" mocap="true" pos="{mover.x!r} {mover.y!r} {half!r}"><geom name="mover {i}"'
            f' type="cylinder" size="{mover.radius!r} {half!r}" {bits} {_NEGLIGIBLE_FORCE}/></body>'
            for i, mover in enumerate(self.world.movers)
        ]
        return "".join(elements)

    @property
    def assets(self) -> str:
        """MJCF of the meshes of walls, boxes and polygons."""
        return (
            "<asset>"
            + "".join(
                f'<mesh name="{name}" vertex="{_vertices(outline.corners, self._height)}"/>'
                for name, outline in self.world.outlines
            )
            + "</asset>"
        )

    def hull(self, axle_height: float) -> str:
        """Format the MJCF of the massless hull for a body frame with its origin `axle_height` above the ground [m]."""
        half = 0.5 * (self._height - _CLEARANCE)
        z = _CLEARANCE + half - axle_height
        return (
            f'<geom name="{HULL}" type="box" size="{0.5 * self.length!r} {0.5 * self.width!r} {half!r}"'
            f' pos="0 0 {z!r}" mass="0" contype="{_OBSTACLE_BIT}" conaffinity="0" group="3"/>'
        )

    def enter(self, model: Any, data: Any) -> None:  # noqa: ANN401 - MuJoCo has no types
        """Attach to the compiled model and data; hull contacts are disabled until `restart`."""
        import mujoco  # noqa: PLC0415 - an optional dependency, needed by the physics only

        self._model, self._data, self._mj_step = model, data, mujoco.mj_step
        self._hull = int(model.geom(HULL).id)
        model.geom_contype[self._hull] = 0
        standing = [*self.world.outlines, *((f"post {i}", post) for i, post in enumerate(self.world.posts))]
        self._names_by_geom = {int(model.geom(name).id): name for name, _ in standing}
        self._names_by_geom |= {int(model.geom(f"mover {i}").id): f"mover {i}" for i in range(len(self.world.movers))}
        self._temporary = [
            (obstacle, int(model.geom(name).id)) for name, obstacle in standing if obstacle.until is not None
        ]

    def restart(self) -> None:
        """Clear the contact log and return all obstacles to their initial states."""
        self.log.clear()
        self._model.geom_contype[self._hull] = _OBSTACLE_BIT
        for _, geom in self._temporary:
            self._model.geom_conaffinity[geom] = _OBSTACLE_BIT
        self._update_obstacles(0.0)

    def step(self) -> None:
        """Update the obstacles, advance the physics by one step, and record contacts."""
        data = self._data
        time = data.time
        self._update_obstacles(time)
        velocity, position = data.qvel[:6].copy(), data.qpos[:2].copy()
        self._mj_step(self._model, data)
        if data.ncon:
            self._record_contacts(time, velocity, position)

    def _update_obstacles(self, time: float) -> None:
        for i, mover in enumerate(self.world.movers):
            self._data.mocap_pos[i, :2] = mover.position(time)
        for obstacle, geom in self._temporary:
            if not is_present(obstacle, time):
                self._model.geom_conaffinity[geom] = 0

    def _record_contacts(self, time: float, velocity: FloatArray, position: FloatArray) -> None:
        pairs = self._data.contact.geom
        for i in np.flatnonzero((pairs == self._hull).any(axis=1)):
            obstacle = int(pairs[i].sum()) - self._hull
            x, y = (float(coordinate) for coordinate in self._data.contact.pos[i, :2])
            # Velocity of the hull at the contact point, for a rotation about the vertical axis.
            vx = velocity[0] - velocity[5] * (y - position[1])
            vy = velocity[1] + velocity[5] * (x - position[0])
            self.log.record(float(time), self._names_by_geom[obstacle], x, y, math.hypot(vx, vy))


def _vertices(corners: FloatArray, height: float) -> str:
    """Format the vertices of a prism relative to its centre."""
    centred = corners - corners.mean(axis=0)
    return " ".join(f"{float(x)!r} {float(y)!r} {z!r}" for z in (-height / 2, height / 2) for x, y in centred)


def _prism(name: str, corners: FloatArray, height: float) -> str:
    """Format the MJCF of a vertical prism with a convex base."""
    x, y = corners.mean(axis=0)
    return (
        f'<body pos="{float(x)!r} {float(y)!r} {height / 2!r}"><geom name="{name}" type="mesh" mesh="{name}"'
        f' contype="0" conaffinity="{_OBSTACLE_BIT}"/></body>'
    )
