"""A controller that is watched while it drives; what it decides is what it decides unwatched."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import typer

from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.view.body import robot_body
from diffdrive_mpc.sim.view.viewer import Viewer

_NO_PLAN: FloatArray = np.empty((0, 2))
_POINTS = 2000
"""Of the reference in the window."""


@contextmanager
def watched(
    controller: TrackingController, plant: Plant, reference: Reference, name: str, surface: str
) -> Iterator[TrackingController]:
    """Open the viewer, and give the controller as one that is watched.

    Parameters
    ----------
    controller, plant, reference
        Of the run.
    name, surface
        By which the plant and its floor are known; a plant without a body looks like the shipped robot.

    Raises
    ------
    sim.view.viewer.NoDisplayError
        If no window can be opened.
    """
    path = reference.sample(np.linspace(0.0, reference.duration, _POINTS)).pose
    body = robot_body(name) or robot_body()
    assert body is not None
    with Viewer(body, surface, path[:, :2], metric_settings().band, path[0]) as viewer:
        yield Watched(controller, plant, viewer)
        closed = not viewer.open
    if closed:
        typer.echo("the viewer was closed; the run went on without it, as fast as it could")


class Watched:
    """Shows each tick in a viewer, and passes everything on as it is; see `models.interface.TrackingController`.

    Parameters
    ----------
    controller, plant
        Who drives, and where; the plant is only looked at.
    viewer
        The open window.
    """

    def __init__(self, controller: TrackingController, plant: Plant, viewer: Viewer) -> None:
        self._controller, self._plant, self._viewer = controller, plant, viewer
        self._way: list[FloatArray] = []
        self._angles = np.zeros(4)

    def start(self, reference: Reference, t0: float) -> None:
        """As the controller does."""
        self._way.clear()
        self._controller.start(reference, t0)

    def step(self, t: float, measurement: Measurement) -> ControlStep:
        """As the controller does, and then show it."""
        step = self._controller.step(t, measurement)
        speeds = measurement.wheel_speeds
        if speeds is not None:
            self._angles += self._plant.sample_time * np.nan_to_num(np.asarray(speeds.value, dtype=float))
        pose = self._plant.true_pose
        self._way.append(pose[:2].copy())
        plan = _NO_PLAN if step.plan is None else step.plan[:, :2]
        self._viewer.show(t, pose, self._angles, np.array(self._way), plan)
        return step
