"""MuJoCo model of the robot for pictures; the simulated plant uses a different model."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.make import plant_body

GREY, BLUE, ORANGE = (0.25, 0.25, 0.25, 1.0), (0.0, 0.45, 0.70, 1.0), (0.90, 0.38, 0.0, 1.0)
_SEGMENTS = 300
"""Number of straight segments of a drawn line."""
_TYRE_WIDTH = 0.6
"""Ratio of tyre width and wheel radius [-], chosen for the pictures."""
_WORLD = """
<mujoco><option gravity="0 0 0"/><visual><global offwidth="1280" offheight="720"/><quality offsamples="4"/>
<headlight ambient="0.4 0.4 0.4" diffuse="0.4 0.4 0.4"/></visual><statistic extent="2"/>
<asset><texture type="skybox" builtin="gradient" rgb1="0.9 0.95 1" rgb2="1 1 1" width="64" height="384"/>
<texture name="floor" type="2d" builtin="checker" rgb1="0.80 0.80 0.78" rgb2="0.75 0.75 0.73" width="512" height="512"/>
<material name="floor" texture="floor" texrepeat="2 2" texuniform="true" reflectance="0.05"/></asset>
<default><geom contype="0" conaffinity="0" mass="1"/></default><worldbody>
<geom type="plane" size="0 0 1" material="floor"/><light directional="true" dir="0.3 -0.4 -0.9" diffuse="0.4 0.4 0.4"/>
<body pos="0 0 {radius}"><freejoint/>
<geom type="box" size="{length} {width} {height}" pos="0 0 {centre}" rgba="0.6 0.6 0.62 1"/>
<geom type="box" size="{length} {width} 0.006" pos="0 0 {top}" rgba="0 0.45 0.7 1"/>
<geom type="box" size="0.02 {half_front} 0.008" pos="{front} 0 {top}" rgba="1 0.68 0 1"/>{wheels}</body>
</worldbody></mujoco>
"""
_WHEEL = """
<body pos="{x} {y} 0"><joint type="hinge" axis="0 1 0"/>
<geom type="cylinder" size="{radius} {tyre}" euler="90 0 0" rgba="0.1 0.1 0.1 1"/>
<geom type="box" size="{spoke} {rim} 0.004" rgba="0.7 0.7 0.7 1"/></body>
"""


class RobotScene:
    """MuJoCo model of the robot of a plant on a plane.

    Parameters
    ----------
    plant
        Name of the plant; "model:NAME" shows the robot of the papers.
    """

    def __init__(self, plant: str) -> None:
        import mujoco  # noqa: PLC0415 - an optional dependency

        robot, twin = plant_body(plant)
        length, width, height = (size / 2 for size in twin.chassis.body_size)
        radius, tyre, centre = robot.wheel_radius, _TYRE_WIDTH * robot.wheel_radius / 2, twin.chassis.body_height
        wheels = "".join(
            _WHEEL.format(x=x, y=y, radius=radius, tyre=tyre, spoke=0.6 * radius, rim=1.02 * tyre)
            for x in (twin.chassis.wheel_base / 2, -twin.chassis.wheel_base / 2)
            for y in (robot.track / 2, -robot.track / 2)
        )
        body = {"length": length, "width": width, "height": height, "centre": centre, "top": centre + height}
        direction_mark = {"front": 0.8 * length, "half_front": 0.7 * width}
        self.height = radius + centre + 1.2 * height
        self.model: Any = mujoco.MjModel.from_xml_string(
            _WORLD.format(radius=radius, wheels=wheels, **body, **direction_mark)
        )
        self.data: Any = mujoco.MjData(self.model)

    def place(self, pose: ArrayLike, wheel_angles: ArrayLike = (0.0, 0.0, 0.0, 0.0)) -> None:
        """Move the robot to `pose` (3,) with wheel angles (4,) [rad]."""
        import mujoco  # noqa: PLC0415 - an optional dependency

        x, y, theta = np.asarray(pose, dtype=float)
        self.data.qpos[:2] = x, y
        self.data.qpos[3:7] = math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)
        self.data.qpos[7:] = wheel_angles
        mujoco.mj_forward(self.model, self.data)


def draw_line(scene: Any, points: FloatArray, height: float, colour: tuple[float, ...], width: float = 0.008) -> None:  # noqa: ANN401 - untyped
    """Add a line through `points` (n, 2) [m] at a height [m] to a MuJoCo scene; `width` is the line's radius [m]."""
    import mujoco  # noqa: PLC0415 - an optional dependency

    rows = np.column_stack([points, np.full(len(points), height)])
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, _SEGMENTS + 1).astype(int))]
    for start, end in itertools.pairwise(rows):
        geom, shape = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
        rgba = np.array(colour, dtype=np.float32)
        mujoco.mjv_initGeom(geom, shape, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
        mujoco.mjv_connector(geom, shape, width, start, end)
        scene.ngeom += 1
