"""MuJoCo's viewer on a running drive: a window of its own model, which the plant does not know of."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
import warnings
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.body import BodyShape
from diffdrive_mpc.sim.view.marks import draw_marks
from diffdrive_mpc.sim.view.scene import Scene
from diffdrive_mpc.sim.view.shots import overview

if TYPE_CHECKING:
    from typing import Self

_ASPECT = 1.5
_CLOSING_TIME = 30.0
"""For which closing is waited at most [s]."""
_REMEDY = "make a film instead: --animate drive.mp4 --render; over ssh, ssh -X gives a display"


class NoDisplayError(DiffdriveMpcError):
    """There is nothing to open a window on. One line: why, and what to do instead."""


class Viewer:
    """A window on a drive, in real time. Closing it ends nothing but the view.

    Parameters
    ----------
    body, surface
        Lengths of the robot, name of the floor.
    reference, band
        (k, 2) the path [m] and half the width of the strip along it [m].
    start
        (3,) x, y [m], theta [rad] of the robot.

    Raises
    ------
    NoDisplayError
        When it is entered, if no window can be opened.
    """

    def __init__(self, body: BodyShape, surface: str, reference: FloatArray, band: float, start: ArrayLike) -> None:
        require_display()
        self._scene = Scene(body, surface, reference=reference, band=band)
        self._scene.place(start, np.zeros(4))
        self._aim = overview(reference, 2.0 * body.footprint[0], _ASPECT)
        self._handle: Any = None
        self._drawing: set[threading.Thread] = set()
        self._began = math.nan
        self.pictures = 0
        """How many were shown."""

    @property
    def open(self) -> bool:
        """Whether the window is there."""
        return self._handle is not None and bool(self._handle.is_running())

    def __enter__(self) -> Self:
        """Open the window."""
        import mujoco.viewer  # noqa: PLC0415 - optional, and needs a display

        _try_window()
        before = set(threading.enumerate())
        self._handle = mujoco.viewer.launch_passive(
            self._scene.model, self._scene.data, show_left_ui=False, show_right_ui=False
        )
        self._drawing = set(threading.enumerate()) - before
        with self._handle.lock():
            eye = self._handle.cam
            eye.lookat[:], eye.distance, eye.azimuth, eye.elevation = self._aim[:3], *self._aim[3:]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the window, and wait until it is: what still draws when Python ends crashes it."""
        self._handle.close()
        for thread in self._drawing:
            thread.join(_CLOSING_TIME)

    def show(self, t: float, pose: ArrayLike, wheel_angles: ArrayLike, way: FloatArray, plan: FloatArray) -> None:
        """Show the robot at time `t` [s] as `Scene.place` has it, with `way` (m, 2) and `plan` (p, 2) [m].

        It waits until so much time has passed since the first picture. Of a closed window it does nothing.
        """
        if not self.open:
            return
        with self._handle.lock():
            self._scene.place(pose, wheel_angles)
            self._handle.user_scn.ngeom = 0
            draw_marks(self._handle.user_scn, way, plan, self._scene.above)
        self._handle.sync()
        self.pictures += 1
        now = time.monotonic()
        if math.isnan(self._began):
            self._began = now - t
        time.sleep(max(0.0, self._began + t - now))


def _try_window() -> None:
    """Open a hidden window and close it; raises NoDisplayError. MuJoCo's viewer would wait for ever for one."""
    import glfw  # noqa: PLC0415 - comes with MuJoCo

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "", None, None)
            glfw.default_window_hints()
    if not window:
        why = f" ({caught[0].message})" if caught else ""
        raise NoDisplayError(f"--view: no window can be opened{why}; {_REMEDY}")
    glfw.destroy_window(window)


def require_display() -> None:
    """Raise NoDisplayError where no screen can be there; whether one is shows when the window opens."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise NoDisplayError(f"--view: there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set); {_REMEDY}")
