"""MuJoCo's pictures: the robot where it is, seen without a display; a viewer that changes nothing."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc.sim.view.body import robot_body
from diffdrive_mpc.sim.view.marks import ribbon, thinned
from diffdrive_mpc.sim.view.offscreen import NoOpenGLError, painted
from diffdrive_mpc.sim.view.shots import Camera, Shots
from diffdrive_mpc.sim.view.viewer import NoDisplayError, Viewer

SIZE = (320, 240)
PLACES = np.array([(x, y) for x in (-0.6, 0.0, 0.5) for y in (-0.4, 0.1, 0.6)])
FRAME = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
DARK = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}
"""An environment as on a server."""


def shots(poses, *, plans=None, angles=None, camera=Camera.FIXED, surface="default"):
    count = len(poses)
    return Shots(
        time=0.1 * np.arange(count),
        poses=np.asarray(poses, dtype=float),
        wheel_angles=np.zeros((count, 4)) if angles is None else angles,
        passed=np.zeros(count, dtype=int),
        plans=np.empty((count, 0, 2)) if plans is None else plans,
        way=FRAME,
        reference=FRAME,
        band=0.05,
        body=robot_body(),
        surface=surface,
        camera=camera,
        size=SIZE,
    )


def pictures(what, environment=DARK):
    with painted(what, environment) as frames:
        return [frame.astype(int) for frame in frames]


def amber(picture):
    """Rows and columns of the mark at the robot's front."""
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    return np.argwhere((red > 150) & (green > 0.55 * red) & (green < 0.85 * red) & (blue < 0.35 * red))


def homography(floor, pixels):
    """The map of a plane to a picture that fits best, by the direct linear transform."""
    rows = []
    for (x, y), (u, v) in zip(floor, pixels, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    return np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)


@pytest.mark.system("rendering")
def test_the_robot_is_where_a_camera_sees_that_place():
    """Places in a plane and their pictures are one projection: eight numbers explain eighteen."""
    poses = np.column_stack([PLACES, np.zeros(len(PLACES))])
    seen = np.array([amber(frame).mean(axis=0)[::-1] for frame in pictures(shots(poses))])
    found = np.column_stack([PLACES, np.ones(len(PLACES))]) @ homography(PLACES, seen).T
    assert np.abs(found[:, :2] / found[:, 2:] - seen).max() < 1.0
    right, up = seen[PLACES[:, 0] > 0.4].mean(axis=0), seen[PLACES[:, 1] > 0.5].mean(axis=0)
    assert right[0] > seen[:, 0].mean() + 30
    assert up[1] < seen[:, 1].mean() - 10


@pytest.mark.system("rendering")
def test_the_chasing_camera_keeps_the_robot_in_the_picture_and_its_front_ahead():
    turns = np.linspace(0.0, 12.0, 9)
    poses = np.column_stack([3.0 * np.cos(turns), 3.0 * np.sin(turns), turns + np.pi / 2])
    for frame in pictures(shots(poses, camera=Camera.CHASE)):
        row, column = amber(frame).mean(axis=0)
        assert 0.2 * SIZE[0] < column < 0.8 * SIZE[0]
        assert row < 0.75 * SIZE[1]


@pytest.mark.system("rendering")
def test_plan_wheels_and_floor_show():
    still = np.zeros((3, 3))
    plans = np.full((3, 2, 2), np.nan)
    plans[1] = [(0.3, 0.0), (0.8, 0.4)]
    angles = np.zeros((3, 4))
    angles[2] = 0.6
    plain, planned, turned = pictures(shots(still, plans=plans, angles=angles))
    vermillion = (planned[..., 0] > 150) & (planned[..., 1] < 0.6 * planned[..., 0]) & (planned[..., 2] < 60)
    new = (planned != plain).any(axis=2)
    assert 20 < new.sum() < 2000
    assert (vermillion & new).sum() > 50  # the rest are smooth edges, and its image in the floor
    assert 3 < (turned != plain).any(axis=2).sum() < 500
    (icy,) = pictures(shots(still[:1], surface="ice"))
    assert (icy != plain).any(axis=2).mean() > 0.5


@pytest.mark.system("rendering")
def test_where_egl_fails_osmesa_paints_the_same():
    without_egl = {**DARK, "__EGL_VENDOR_LIBRARY_DIRS": "/nowhere", "LIBGL_DRIVERS_PATH": "/nowhere"}
    with (
        pytest.raises(NoOpenGLError, match="egl: "),
        painted(shots(np.zeros((1, 3))), {**without_egl, "MUJOCO_GL": "egl"}),
    ):
        pass
    (one,), (other,) = pictures(shots(np.zeros((1, 3))), without_egl), pictures(shots(np.zeros((1, 3))))
    assert np.abs(one - other).max() <= 8


def test_what_the_user_set_is_not_overruled_and_the_line_names_the_remedy():
    with (
        pytest.raises(NoOpenGLError, match=r"glfw: .*libegl1 .* libosmesa6 .*unset MUJOCO_GL, which is 'glfw'"),
        painted(shots(np.zeros((1, 3))), {**DARK, "MUJOCO_GL": "glfw"}),
    ):
        pass


@pytest.mark.system("rendering")
def test_two_paintings_agree_in_every_bit():
    poses = [(0.2, 0.1, 0.3), (0.3, 0.2, 0.5)]
    for one, other in zip(pictures(shots(poses)), pictures(shots(poses)), strict=True):
        assert np.array_equal(one, other)


def test_a_body_is_that_of_the_robot_file():
    shipped, long = robot_body("mujoco"), robot_body("mujoco:long")
    assert shipped.track == 0.330
    assert long.footprint[0] == pytest.approx(0.45)
    assert robot_body("model:ssm") is None


def area(corners, triangles):
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    return 0.5 * float(np.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


def test_a_ribbon_has_the_area_of_its_path():
    """Length times width, whatever the bends (Pappus); a reversal begins a new piece on the same floor."""
    turns = np.linspace(0.0, 2 * np.pi, 400)
    circle = np.column_stack([np.cos(turns), np.sin(turns)])
    assert area(*ribbon(circle, 0.05)) == pytest.approx(2 * np.pi * 0.1, rel=2e-3)
    there = np.column_stack([np.linspace(0.0, 1.0, 50), np.zeros(50)])
    assert area(*ribbon(np.concatenate([there, there[::-1]]), 0.05)) == pytest.approx(2 * 0.1, rel=1e-6)


def test_thinned_keeps_both_ends():
    points = np.column_stack([np.linspace(0.0, 1.0, 1001), np.zeros(1001)])
    kept = thinned(points, 0.05)
    assert kept[0, 0] == 0.0
    assert kept[-1, 0] == 1.0
    assert np.diff(kept[:, 0]).min() > 0.0
    assert np.diff(kept[:, 0]).max() < 0.052
    assert thinned(np.zeros((5, 2)), 0.05).size == 0


def test_without_a_display_the_viewer_says_what_to_do(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(NoDisplayError, match=r"no display .*--animate drive.mp4 --render"):
        Viewer(robot_body(), "default", FRAME, 0.05, np.zeros(3))


def test_a_display_that_is_not_there_is_no_wait_for_ever(monkeypatch):
    code = "from test_view import *; Viewer(robot_body(), 'default', FRAME, 0.05, np.zeros(3)).__enter__()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**DARK, "DISPLAY": ":97"},
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert "no window can be opened" in done.stderr


CLOSED_ON_THE_WAY = """
    import time, numpy as np
    from diffdrive_mpc.sim.view.body import robot_body
    from diffdrive_mpc.sim.view.viewer import Viewer

    path = np.array([(0.0, 0.0), (1.0, 0.0)])
    with Viewer(robot_body(), "default", path, 0.05, np.zeros(3)) as viewer:
        for t in (0.0, 0.1, 0.2):
            viewer.show(t, (t, 0.0, 0.0), np.zeros(4), path, path)
        shown = viewer.pictures
        viewer._handle.close()
        while viewer.open:
            time.sleep(0.01)
        began = time.monotonic()
        for t in (10.0, 1000.0):
            viewer.show(t, (t, 0.0, 0.0), np.zeros(4), path, path)
        print(shown, viewer.pictures, time.monotonic() - began < 5.0)
"""


@pytest.mark.system("window")
def test_a_window_that_is_closed_stops_the_view_and_nothing_else():
    code = textwrap.dedent(CLOSED_ON_THE_WAY)
    screen = ["xvfb-run", "-a", "-s", "-screen 0 640x480x24"]
    done = subprocess.run([*screen, sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["3", "3", "True"]
