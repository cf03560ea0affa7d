"""Paints shots with MuJoCo, off-screen: `python -m diffdrive_mpc.sim.view.painter SHOTS.npz`.

It runs in a process of its own because MuJoCo chooses what it draws with (MUJOCO_GL) when it is loaded, once for all.
On stdout it writes a line with the word `READY`, then each picture as rows of red, green, blue bytes.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.marks import draw_marks
from diffdrive_mpc.sim.view.scene import Scene
from diffdrive_mpc.sim.view.shots import Camera, Shots

READY = b"READY\n"
_MOST_SHAPES = 20_000
_FIELD_OF_VIEW = math.radians(40.0)  # vertical, as in the scene
_SWING_TIME = 0.6  # [s], with which the camera follows a turn
_CHASE_ELEVATION, _FIXED_ELEVATION = -32.0, -48.0  # [degrees]
_ASIDE = 22.0  # [degrees], the camera behind the robot stands beside its track, so that the wheels are seen


def paint(shots: Shots, write: Any) -> None:  # noqa: ANN401 - anything with the signature of file.write
    """Paint every picture, in order."""
    import mujoco  # noqa: PLC0415 - loaded here only, see above

    width, height = shots.size
    scene = Scene(shots.body, shots.surface, shots.size, shots.reference, shots.band)
    eye = mujoco.MjvCamera()
    aims = chase(shots) if shots.camera == Camera.CHASE else fixed(shots)
    with mujoco.Renderer(scene.model, height, width, max_geom=_MOST_SHAPES) as renderer:
        renderer.update_scene(scene.data)
        renderer.render()
        write(READY)
        for k, aim in enumerate(aims):
            scene.place(shots.poses[k], shots.wheel_angles[k])
            eye.lookat[:], eye.distance, eye.azimuth, eye.elevation = aim[:3], aim[3], aim[4], aim[5]
            renderer.update_scene(scene.data, eye)
            draw_marks(renderer.scene, shots.way[: shots.passed[k]], shots.plans[k])
            write(renderer.render().tobytes())


def chase(shots: Shots) -> FloatArray:
    """(m, 6) point looked at [m], distance [m], azimuth and elevation [degrees]: behind the robot, swinging softly."""
    length, _ = shots.body.footprint
    heading = np.unwrap(shots.poses[:, 2])
    for k in range(1, len(heading)):
        share = 1.0 - math.exp(-abs(shots.time[k] - shots.time[k - 1]) / _SWING_TIME)
        heading[k] = heading[k - 1] + share * (heading[k] - heading[k - 1])
    ahead = 0.6 * length * np.column_stack([np.cos(heading), np.sin(heading)])
    rest = [5.2 * length, 0.0, _CHASE_ELEVATION]
    aims = np.column_stack([shots.poses[:, :2] + ahead, np.zeros(len(heading)), np.tile(rest, (len(heading), 1))])
    aims[:, 4] = np.degrees(heading) + _ASIDE
    return aims


def fixed(shots: Shots) -> FloatArray:
    """(m, 6) as `chase` has it: the whole path in view, x to the right."""
    seen = np.concatenate([shots.reference, shots.way, shots.poses[:, :2]])
    seen = seen[np.isfinite(seen).all(axis=1)]
    low, high = seen.min(axis=0), seen.max(axis=0)
    extent = high - low + 2.0 * shots.body.footprint[0]
    width, height = shots.size
    # Seen from aslant, what is near looks larger: a fifth more than the middle needs.
    needed = max(float(extent[1]) * math.sin(math.radians(-_FIXED_ELEVATION)), float(extent[0]) * height / width)
    distance = 1.2 * 0.5 * needed / math.tan(_FIELD_OF_VIEW / 2)
    return np.tile([*(0.5 * (low + high)), 0.0, distance, 90.0, _FIXED_ELEVATION], (len(shots.poses), 1))


if __name__ == "__main__":
    paint(Shots.load(Path(sys.argv[1])), sys.stdout.buffer.write)
