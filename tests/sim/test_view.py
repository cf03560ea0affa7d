"""MuJoCo's viewer on a drive."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc.sim.viewer import GREY, NoDisplayError, RobotScene, draw_line, require_display

SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
COMMAND = Path(sys.executable).with_name("diffdrive-mpc")
DARK = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}


def simulate_short(folder: Path, *words: str, before: tuple[str, ...] = (), **environment: str) -> str:
    """Simulate the short path, and return the printed error."""
    (folder / "short.yaml").write_text(SHORT, encoding="utf-8")
    command = [*before, str(COMMAND), "simulate", "--trajectory", "short.yaml", *words]
    done = subprocess.run(
        command, cwd=folder, env=DARK | environment, capture_output=True, text=True, check=False, timeout=300
    )
    return done.stderr if done.returncode else ""


def test_missing_display_is_named_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(NoDisplayError, match=r"no display .*use --out FOLDER for a report"):
        require_display()


def test_unreachable_display_ends_with_one_line(tmp_path: Path) -> None:
    printed = simulate_short(tmp_path, "--view", DISPLAY=":97")
    (line,) = printed.strip().splitlines()
    assert line.startswith("error: --view: no window can be opened")


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


def test_line_keeps_both_ends_and_fits_the_viewer() -> None:
    import mujoco

    scene = mujoco.MjvScene(RobotScene("mujoco").model, maxgeom=1000)
    points = np.column_stack([np.linspace(0.0, 1.0, 5001), np.zeros(5001)])
    draw_line(scene, points, 0.1, GREY)
    assert scene.ngeom == 300
    middles = np.array([geom.pos for geom in scene.geoms[: scene.ngeom]])
    assert middles[[0, -1], 0] == pytest.approx([0.5 / 300, 1.0 - 0.5 / 300], abs=1e-4)
    assert middles[:, 2] == pytest.approx(0.1)


@pytest.mark.system("window")
def test_viewed_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    screen = ("xvfb-run", "-a", "-s", "-screen 0 640x480x24")
    assert simulate_short(tmp_path, "--log", "plain.csv") == ""
    assert simulate_short(tmp_path, "--view", "--log", "viewed.csv", before=screen) == ""
    plain, viewed = (list(csv.DictReader((tmp_path / f"{name}.csv").open())) for name in ("plain", "viewed"))
    times = {"step_time_s", "solve_time_s"}
    assert [{k: v for k, v in row.items() if k not in times} for row in plain] == [
        {k: v for k, v in row.items() if k not in times} for row in viewed
    ]
