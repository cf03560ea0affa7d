"""Paints shots with MuJoCo, off-screen: `python -m diffdrive_mpc.sim.view.painter SHOTS.npz`.

It runs in a process of its own because MuJoCo chooses what it draws with (MUJOCO_GL) when it is loaded, once for all.
On stdout it writes a line with the word `READY`, then each picture as rows of red, green, blue bytes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.marks import draw_marks
from diffdrive_mpc.sim.view.scene import Scene
from diffdrive_mpc.sim.view.shots import Camera, Shots, chase, overview

READY = b"READY\n"
_MOST_SHAPES = 20_000


def paint(shots: Shots, write: Any) -> None:  # noqa: ANN401 - anything with the signature of file.write
    """Paint every picture, in order."""
    import mujoco  # noqa: PLC0415 - loaded here only, see above

    width, height = shots.size
    scene = Scene(shots.body, shots.surface, shots.size, shots.reference, shots.band)
    eye = mujoco.MjvCamera()
    with mujoco.Renderer(scene.model, height, width, max_geom=_MOST_SHAPES) as renderer:
        renderer.update_scene(scene.data)
        renderer.render()
        write(READY)
        for k, aim in enumerate(_aims(shots)):
            scene.place(shots.poses[k], shots.wheel_angles[k])
            eye.lookat[:], eye.distance, eye.azimuth, eye.elevation = aim[:3], aim[3], aim[4], aim[5]
            renderer.update_scene(scene.data, eye)
            draw_marks(renderer.scene, shots.way[: shots.passed[k]], shots.plans[k], scene.above)
            write(renderer.render().tobytes())


def _aims(shots: Shots) -> FloatArray:
    length, _ = shots.body.footprint
    if shots.camera == Camera.CHASE:
        return chase(shots.time, shots.poses, length)
    points = np.concatenate([shots.reference, shots.way, shots.poses[:, :2]])
    return np.tile(overview(points, length, shots.size[0] / shots.size[1]), (len(shots.time), 1))


if __name__ == "__main__":
    paint(Shots.load(Path(sys.argv[1])), sys.stdout.buffer.write)
