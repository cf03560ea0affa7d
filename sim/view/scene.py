"""A MuJoCo model of how robot and floor look; it has no contacts and is never stepped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.body import BodyShape, Colour, load_looks
from diffdrive_mpc.sim.view.marks import ribbon
from diffdrive_mpc.sim.view.shots import FIELD_OF_VIEW

_SPOKES = 5
_SHADE_HEIGHT = 0.006  # [m], over the floor and what lies on it
_LAYER = 0.001  # [m], between what lies on the floor
NO_PATH: FloatArray = np.empty((0, 2))


class Scene:
    """The robot on its floor, put where it is to be seen.

    Parameters
    ----------
    body
        Lengths of the robot.
    surface
        Name of the floor.
    size
        Largest picture, width and height [pixels].
    reference
        (k, 2) the path [m]; empty for none.
    band
        Half the width of the strip along it [m].

    Attributes
    ----------
    model, data
        Of MuJoCo.
    above
        A height that is above the robot's deck [m].
    """

    def __init__(
        self,
        body: BodyShape,
        surface: str = "default",
        size: tuple[int, int] = (1280, 720),
        reference: FloatArray = NO_PATH,
        band: float = 0.0,
    ) -> None:
        import mujoco  # noqa: PLC0415 - optional, and what it draws with is chosen before it is loaded

        self._kinematics = mujoco.mj_forward
        self._radius, self.above = body.wheel_radius, body.top + 0.25 * body.size[2]
        marks = load_looks().marks
        paths = {"band": (reference, band), "reference": (reference, marks.reference.radius)}
        paths = paths if len(reference) > 1 else {}
        self.model: Any = mujoco.MjModel.from_xml_string(scene_xml(body, surface, size, paths))
        self.data: Any = mujoco.MjData(self.model)
        self.place((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))

    def place(self, pose: ArrayLike, wheel_angles: ArrayLike) -> None:
        """Put the robot at `pose` (3,) x, y [m], theta [rad], its wheels turned by `wheel_angles` (4,) [rad]."""
        x, y, theta = (float(value) for value in _flat(pose))
        turned = [math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)]
        self.data.qpos[:7] = [x, y, self._radius, *turned]
        self.data.qpos[7:] = _flat(wheel_angles)
        self._kinematics(self.model, self.data)


def _flat(values: ArrayLike) -> FloatArray:
    return np.asarray(values, dtype=float).reshape(-1)


def scene_xml(
    body: BodyShape, surface: str, size: tuple[int, int], paths: Mapping[str, tuple[FloatArray, float]]
) -> str:
    """The model in MuJoCo's XML format; `paths` lie on the floor: by material points (k, 2) and half a width [m]."""
    looks = load_looks()
    floor = looks.floor(surface)
    sky, shades = looks.sky, floor.shades
    materials = "".join(
        f'<material name="{name}" rgba="{_rgb(colour)} 1" specular="{shine}" shininess="{shine}"/>'
        for name, colour, shine in (
            ("body", looks.body, 0.4),
            ("top", looks.top, 0.5),
            ("front", looks.front, 0.3),
            ("tyre", looks.tyre, 0.1),
            ("rim", looks.rim, 0.6),
            ("sensor", looks.sensor, 0.6),
            ("band", looks.marks.band, 0.0),
            ("reference", looks.marks.reference.colour, 0.0),
        )
    )
    lying = "".join(
        f'<geom type="mesh" mesh="{name}" material="{name}" pos="0 0 {layer * _LAYER}"/>'
        for layer, name in enumerate(paths, start=1)
    )
    return (
        '<mujoco><compiler angle="radian"/><option gravity="0 0 0"/>'
        f'<visual><global offwidth="{size[0]}" offheight="{size[1]}" fovy="{FIELD_OF_VIEW}"/>'
        '<headlight ambient="0.44 0.44 0.44" diffuse="0.18 0.18 0.18" specular="0 0 0"/>'
        '<quality shadowsize="0" offsamples="4"/><map znear="0.02" zfar="60"/></visual><statistic extent="1.5"/>'
        "<asset>"
        f'<texture type="skybox" builtin="gradient" rgb1="{_rgb(sky.above)}" rgb2="{_rgb(sky.below)}"'
        ' width="64" height="384"/>'
        f'<texture name="floor" type="2d" builtin="checker" rgb1="{_rgb(shades[0])}" rgb2="{_rgb(shades[1])}"'
        ' width="512" height="512"/>'
        f'<material name="floor" texture="floor" texrepeat="2 2" texuniform="true" reflectance="{floor.mirrors}"'
        ' specular="0.1" shininess="0.1"/>'
        f"{materials}{''.join(_mesh(name, *path) for name, path in paths.items())}</asset>"
        '<default><geom contype="0" conaffinity="0" mass="0.001"/></default>'
        "<worldbody>"
        '<geom name="floor" type="plane" size="0 0 1" material="floor"/>'
        f"{lying}"
        '<light directional="true" dir="0.35 -0.45 -0.82" diffuse="0.46 0.46 0.45" specular="0.2 0.2 0.2"'
        ' castshadow="false"/>'
        '<light directional="true" dir="-0.5 0.3 -0.8" diffuse="0.16 0.16 0.17" specular="0 0 0" castshadow="false"/>'
        f'<body name="robot" pos="0 0 {body.wheel_radius}"><freejoint/>'
        f"{_shade(body)}{_hull(body)}{_wheels(body)}</body></worldbody></mujoco>"
    )


def _mesh(name: str, path: FloatArray, half_width: float) -> str:
    corners, faces = ribbon(path, half_width)
    points = np.column_stack([corners, np.zeros(len(corners))]).round(5)
    vertex, face = (" ".join(map(str, rows.ravel().tolist())) for rows in (points, faces))
    return f'<mesh name="{name}" inertia="shell" vertex="{vertex}" face="{face}"/>'


def _rgb(colour: Colour) -> str:
    return " ".join(map(str, colour))


def _box(material: str, size: tuple[float, float, float], at: tuple[float, float, float]) -> str:
    half, place = (" ".join(f"{value:.5g}" for value in values) for values in ((s / 2 for s in size), at))
    return f'<geom type="box" material="{material}" size="{half}" pos="{place}"/>'


def _shade(body: BodyShape) -> str:
    """A soft shadow on the floor: cast by a light, it would be jagged, and as slow as all the rest."""
    length, width = body.footprint
    height = _SHADE_HEIGHT - body.wheel_radius
    return "".join(
        f'<geom type="ellipsoid" rgba="0 0 0 0.02" size="{grown * length:.5g} {grown * width:.5g} 0.0002"'
        f' pos="0 0 {height + 0.0001 * layer:.5g}"/>'
        for layer, grown in enumerate(np.linspace(0.72, 0.5, 22))
    )


def _hull(body: BodyShape) -> str:
    """Box, deck, a bright front, and a sensor on the deck."""
    length, width, height = body.size
    top = body.height + height / 2
    deck, lip = 0.12 * height, 0.03 * length
    turret = 0.16 * width
    return "".join(
        (
            _box("body", (length, width, height), (0.0, 0.0, body.height)),
            _box("top", (length + lip, width + lip, deck), (0.0, 0.0, top + deck / 2)),
            _box("front", (0.10 * length, 0.7 * width, 1.05 * deck), (0.40 * length, 0.0, top + 0.56 * deck)),
            _box("front", (0.02 * length, 0.5 * width, 0.2 * height), (0.505 * length, 0.0, body.height)),
            f'<geom type="cylinder" material="sensor" size="{turret:.5g} {0.2 * height:.5g}"'
            f' pos="{-0.08 * length:.5g} 0 {top + deck + 0.2 * height:.5g}"/>',
            f'<geom type="cylinder" material="rim" size="{0.96 * turret:.5g} {0.03 * height:.5g}"'
            f' pos="{-0.08 * length:.5g} 0 {top + deck + 0.42 * height:.5g}"/>',
        )
    )


def _wheels(body: BodyShape) -> str:
    """Tyres with rims whose spokes show that they turn; front left, front right, rear left, rear right."""
    x, y, radius, width = body.wheel_base / 2, body.track / 2, body.wheel_radius, body.wheel_width
    spokes = "".join(_spoke(radius, width, 2 * math.pi * k / _SPOKES) for k in range(_SPOKES))
    shape = (
        f'<geom type="cylinder" material="tyre" size="{radius:.5g} {width / 2:.5g}" euler="{math.pi / 2} 0 0"/>'
        f'<geom type="cylinder" material="sensor" size="{0.68 * radius:.5g} {0.505 * width:.5g}"'
        f' euler="{math.pi / 2} 0 0"/>{spokes}'
    )
    places = ((x, y), (x, -y), (-x, y), (-x, -y))
    return "".join(
        f'<body pos="{ahead} {left} 0"><joint type="hinge" axis="0 1 0"/>{shape}</body>' for ahead, left in places
    )


def _spoke(radius: float, width: float, angle: float) -> str:
    reach = 0.34 * radius
    return (
        f'<geom type="box" material="rim" size="{reach:.5g} {0.52 * width:.5g} {0.07 * radius:.5g}"'
        f' pos="{reach * math.cos(angle):.5g} 0 {-reach * math.sin(angle):.5g}" euler="0 {angle:.5g} 0"/>'
    )
