"""The robot in pictures of MuJoCo."""

import numpy as np
import pytest

from studies.site.robot_scene import GREY, RobotScene, draw_line


@pytest.mark.parametrize("plant", ["mujoco", "mujoco:heavy", "model:sm", "drawn:3"])
def test_scene_has_the_robot_at_its_pose(plant: str) -> None:
    scene = RobotScene(plant)
    scene.place((1.0, 2.0, np.pi / 2), (0.1, 0.2, 0.3, 0.4))
    assert scene.data.qpos[:2].tolist() == [1.0, 2.0]
    forward = scene.data.xmat[1].reshape(3, 3)[:, 0]
    assert forward == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    wheels = scene.data.xpos[2:6]
    lowest_point = wheels[:, 2] - scene.model.geom_size[-2, 0]
    assert lowest_point == pytest.approx(0.0, abs=1e-9)
    # The first two wheels are in front, which is +y here.
    assert (wheels[:2, 1] > wheels[2:, 1]).all()


def test_line_keeps_both_ends_and_fits_the_scene() -> None:
    import mujoco

    scene = mujoco.MjvScene(RobotScene("mujoco").model, maxgeom=1000)
    points = np.column_stack([np.linspace(0.0, 1.0, 5001), np.zeros(5001)])
    draw_line(scene, points, 0.1, GREY)
    assert scene.ngeom == 300
    middles = np.array([geom.pos for geom in scene.geoms[: scene.ngeom]])
    assert middles[[0, -1], 0] == pytest.approx([0.5 / 300, 1.0 - 0.5 / 300], abs=1e-4)
    assert middles[:, 2] == pytest.approx(0.1)
