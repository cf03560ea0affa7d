"""A drive as a film, drawn picture by picture with a progress bar."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.animation.film import STILL, WRITERS, Film, film_path
from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.app.animation.recording import read_recording
from diffdrive_mpc.app.command_line.echo import echo
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.models.trust import only_trusted
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.view.body import BodyShape, robot_body
from diffdrive_mpc.sim.view.offscreen import Picture
from diffdrive_mpc.sim.view.viewer import Viewer


@dataclass(frozen=True)
class FilmFile:
    """A film and where it is to be written."""

    path: Path
    film: Film


def animate_log(
    log: Path,
    wanted: FilmFile,
    *,
    mapping: str | None = None,
    plant: str | None = None,
    surface: str | None = None,
    config: Path | None = None,
) -> None:
    """Write the film of a log, and say what the log does not tell.

    Parameters
    ----------
    log, mapping
        As `read_recording` has them.
    wanted
        The film.
    plant, surface
        Which robot and floor it was, as `make_plant` calls them; None for what the log says.
    config
        Configuration of the controller, for the limits of commands.

    Raises
    ------
    models.checked_yaml.ConfigError
        If log or file cannot be used.
    sim.view.offscreen.NoOpenGLError
        If MuJoCo's picture is asked for and cannot be made.
    """
    limits = None if config is None else load_config(config).limits
    with film_draft(wanted.path, "--out") as draft:
        playback = read_recording(log, mapping, None if limits is None else (limits.v, limits.omega))
        body = _told_body(playback, log) if plant is None else robot_body(plant)
        film = replace(wanted.film, surface=surface or playback.surface or wanted.film.surface)
        write_film(playback, film, body, draft)
    for line in missing(playback, body, log.name):
        echo(line)


def _told_body(playback: Playback, log: Path) -> BodyShape | None:
    """Of the robot that the log names; None where it names none, or one that does not ship."""
    try:
        with only_trusted(log):
            return None if playback.plant is None else robot_body(playback.plant)
    except ConfigError:
        return None


@contextmanager
def film_draft(path: Path, option: str) -> Iterator[Path]:
    """A place to write a film to, which then becomes `path`; raises ConfigError at once if that cannot be."""
    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(film_path(path)))
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from error
        yield draft


def write_film(playback: Playback, film: Film, body: BodyShape | None, draft: Path) -> None:
    """Write the film of `playback` to `draft`, whose ending says how; arguments and errors are those of `pictures`."""
    from diffdrive_mpc.app.animation.pictures import pictures  # noqa: PLC0415 - matplotlib loads slowly

    ending = draft.suffix.lower()
    film = replace(film, still=ending == STILL)
    with ProgressBar("drawing") as bar:
        WRITERS[ending](draft, _counted(pictures(playback, film, body), len(film.times(playback)), bar), film.fps)


def _counted(drawn: Iterator[Picture], total: int, bar: ProgressBar) -> Iterator[Picture]:
    for count, picture in enumerate(drawn, start=1):
        yield picture
        bar.at(count, total)


def missing(playback: Playback, body: BodyShape | None, name: str) -> list[str]:
    """Lines on what is not in the picture, and what would bring it there."""
    lines = []
    if not playback.plans.size:
        lines.append(f"{name} holds no plans, so none is drawn; `simulate --animate`, or a log as .mcap, has them")
    if not len(playback.reference):
        lines.append(f"{name} holds no reference, so neither band nor errors are drawn")
    if body is None:
        lines.append(
            "its size is not known: it is an arrow, and to MuJoCo the shipped robot; --plant mujoco:FILE says it"
        )
    return lines


# A controller that is watched while it drives; what it decides is what it decides unwatched.


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
        yield ViewedController(controller, plant, viewer)
        closed = not viewer.open
    if closed:
        echo("the viewer was closed; the run went on without it, as fast as it could")


class ViewedController:
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
