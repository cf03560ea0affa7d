"""A world in MuJoCo: its obstacles as geoms, its movers as bodies that are led, and a watch on the robot's hull."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.worlds.passage import ContactLog
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.world import World, stands

HULL = "hull"
_OBSTACLE_BIT = 2
# A mover exerts no force: a person who walks into a robot does not push it through a wall. MuJoCo's least impedance,
# and slow.
_UNFELT = 'solref="1000 1" solimp="0.0001 0.0001 0.001" priority="1"'
_CLEARANCE = 0.02
"""Clearance of the hull above the floor [m]."""


class WorldScene:
    """Obstacles that a world adds to the model of the robot, and the contacts with them.

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
        """MJCF of everything in the world, for the world's body."""
        parts = [_prism(name, outline.corners, self._height) for name, outline in self.world.outlines]
        bits = f'contype="0" conaffinity="{_OBSTACLE_BIT}"'
        half = 0.5 * self._height
        parts += [
            f'<geom name="post {i}" type="cylinder" size="{post.radius!r} {half!r}" pos="{post.at[0]!r} {post.at[1]!r}'
            f' {half!r}" {bits}/>'
            for i, post in enumerate(self.world.posts)
        ]
        parts += [
            f'<body name="mover {i}" mocap="true" pos="{mover.x!r} {mover.y!r} {half!r}"><geom name="mover {i}"'
            f' type="cylinder" size="{mover.radius!r} {half!r}" {bits} {_UNFELT}/></body>'
            for i, mover in enumerate(self.world.movers)
        ]
        return "".join(parts)

    @property
    def assets(self) -> str:
        """MJCF of the meshes that polygons are."""
        return (
            "<asset>"
            + "".join(
                f'<mesh name="{name}" vertex="{_vertices(outline.corners, self._height)}"/>'
                for name, outline in self.world.outlines
            )
            + "</asset>"
        )

    def hull(self, axle_height: float) -> str:
        """Format the MJCF of the massless hull for the body, whose origin is `axle_height` above the floor [m]."""
        half = 0.5 * (self._height - _CLEARANCE)
        z = _CLEARANCE + half - axle_height
        return (
            f'<geom name="{HULL}" type="box" size="{0.5 * self.length!r} {0.5 * self.width!r} {half!r}"'
            f' pos="0 0 {z!r}" mass="0" contype="{_OBSTACLE_BIT}" conaffinity="0" group="3"/>'
        )

    def enter(self, model: Any, data: Any) -> None:  # noqa: ANN401 - MuJoCo has no types
        """Take over the compiled model; the hull touches nothing until `restart`."""
        import mujoco  # noqa: PLC0415 - an optional dependency, needed by the physics only

        self._model, self._data, self._move = model, data, mujoco.mj_step
        self._hull = int(model.geom(HULL).id)
        model.geom_contype[self._hull] = 0
        standing = [*self.world.outlines, *((f"post {i}", post) for i, post in enumerate(self.world.posts))]
        self._names = {int(model.geom(name).id): name for name, _ in standing}
        self._names |= {int(model.geom(f"mover {i}").id): f"mover {i}" for i in range(len(self.world.movers))}
        self._leaving = [
            (obstacle, int(model.geom(name).id)) for name, obstacle in standing if obstacle.until is not None
        ]

    def restart(self) -> None:
        """Restart: all obstacles return to their places."""
        self.log.clear()
        self._model.geom_contype[self._hull] = _OBSTACLE_BIT
        for _, geom in self._leaving:
            self._model.geom_conaffinity[geom] = _OBSTACLE_BIT
        self._lead(0.0)

    def step(self) -> None:
        """Advance movers by one step of the physics, and record contacts."""
        data = self._data
        time = data.time
        self._lead(time)
        before = data.qvel[:6].copy(), data.qpos[:2].copy()
        self._move(self._model, data)
        if data.ncon:
            self._note(time, *before)

    def _lead(self, time: float) -> None:
        for i, mover in enumerate(self.world.movers):
            self._data.mocap_pos[i, :2] = mover.position(time)
        for obstacle, geom in self._leaving:
            if not stands(obstacle, time):
                self._model.geom_conaffinity[geom] = 0

    def _note(self, time: float, velocity: FloatArray, place: FloatArray) -> None:
        pairs = self._data.contact.geom
        for i in np.flatnonzero((pairs == self._hull).any(axis=1)):
            touched = int(pairs[i].sum()) - self._hull
            x, y = (float(coordinate) for coordinate in self._data.contact.pos[i, :2])
            # The hull's own speed at that place; its body turns about the vertical.
            vx = velocity[0] - velocity[5] * (y - place[1])
            vy = velocity[1] + velocity[5] * (x - place[0])
            self.log.touched(float(time), self._names[touched], x, y, math.hypot(vx, vy))


def _vertices(corners: FloatArray, height: float) -> str:
    """Format the corners of a prism around the middle of its base."""
    around = corners - corners.mean(axis=0)
    return " ".join(f"{float(x)!r} {float(y)!r} {z!r}" for z in (-height / 2, height / 2) for x, y in around)


def _prism(name: str, corners: FloatArray, height: float) -> str:
    x, y = corners.mean(axis=0)
    return (
        f'<body pos="{float(x)!r} {float(y)!r} {height / 2!r}"><geom name="{name}" type="mesh" mesh="{name}"'
        f' contype="0" conaffinity="{_OBSTACLE_BIT}"/></body>'
    )
