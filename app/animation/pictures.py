"""The pictures of a film one by one: what stays is drawn once, and only what moves again for each."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from diffdrive_mpc.app.animation.film import Film, shots_of
from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.app.animation.view_from_above import AMBER, BAND, BLUE, GREEN, VERMILLION, ViewFromAbove
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.view.body import BodyShape, robot_body
from diffdrive_mpc.sim.view.offscreen import Picture, painted

# Errors, commands and speeds over time, drawn as far as the drive has come.


_LEAST_ERROR = 10.0  # [mm], shown at least
_ROOM = 1.15


class Curves:
    """Lines that grow with time in one pair of axes.

    Parameters
    ----------
    axes
        Where.
    time
        (n,) [s].
    series
        By name: (n,) values, colour, line style.
    thickness
        Of lines, 1.0 in a picture 720 pixels high.

    Attributes
    ----------
    moving
        The artists that `update` changes.
    """

    def __init__(
        self, axes: Axes, time: FloatArray, series: dict[str, tuple[FloatArray, str, str]], thickness: float
    ) -> None:
        self._time, self._values = time, [values for values, _, _ in series.values()]
        self._lines = [
            axes.plot([], [], color=colour, linestyle=style, linewidth=2.2 * thickness, label=name)[0]
            for name, (_, colour, style) in series.items()
        ]
        self.moving: list[Artist] = list(self._lines)

    def update(self, k: int, first: int) -> None:
        """Show what was between the instants `first` and `k`."""
        part = slice(first, k + 1)
        for line, values in zip(self._lines, self._values, strict=True):
            line.set_data(self._time[part], values[part])


def error_curves(axes: Axes, playback: Playback, band: float, shown: slice, thickness: float) -> Curves:
    """Position and lateral error [mm] on the band."""
    position, lateral = 1000.0 * playback.position_error, 1000.0 * playback.lateral_error
    axes.axhspan(-1000.0 * band, 1000.0 * band, color=BAND, linewidth=0)
    axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8 * thickness)
    highest = max(_LEAST_ERROR, _largest(position[shown]))
    axes.set(ylim=(min(-0.5 * _LEAST_ERROR, _ROOM * _least(lateral[shown])), _ROOM * highest), ylabel="error [mm]")
    series = {"position": (position, VERMILLION, "-"), "lateral": (lateral, BLUE, "--")}
    return Curves(axes, playback.time, series, thickness)


def speed_curves(axes: Axes, playback: Playback, channel: int, shown: slice, thickness: float) -> Curves:
    """Command and answer of v (channel 0) or omega (1), with the limit of commands where it is known."""
    command, speed = playback.command[:, channel], playback.twist[:, channel]
    least = min(_least(command[shown]), _least(speed[shown]), 0.0)
    most = max(_largest(command[shown]), _largest(speed[shown]), 0.0)
    if playback.limits is not None:
        limit = playback.limits[channel]
        for bound, name in ((limit, "limit"), (-limit, None)):
            axes.axhline(bound, color=REFERENCE_COLOUR, linestyle=":", linewidth=1.8 * thickness, label=name)
        most = limit if most > 0.3 * limit else most
        least = -limit if least < -0.3 * limit else least
    room = 0.12 * max(most - least, 0.1)
    axes.set(ylim=(least - room, most + room), ylabel=("v [m/s]", "ω [rad/s]")[channel])
    series = {"commanded": (command, VERMILLION, "-"), playback.told: (speed, BLUE, "--")}
    return Curves(axes, playback.time, series, thickness)


def _largest(values: FloatArray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0


def _least(values: FloatArray) -> float:
    return float(np.nanmin(values)) if np.isfinite(values).any() else 0.0


_DPI = 100.0
_USUAL_HEIGHT = 720
_LETTERS = 21.0
"""Height of letters in a picture of the usual height [pixels]; on a phone that shows it 360 high, half as many."""
_STYLE: Any = {"font.family": "DejaVu Sans", "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}
_WORDS = {
    "TRACKING": ("tracking", GREEN),
    "REUSED_PLAN": ("last plan reused", AMBER),
    "BRAKING": ("braking", VERMILLION),
    "STOPPED": ("stopped", VERMILLION),
    "FINISHED": ("finished", BLUE),
}
_MESSAGE_WIDTH = 66
"""Letters in a line of the message."""


def pictures(playback: Playback, film: Film, body: BodyShape | None) -> Iterator[Picture]:
    """Every picture of the film, (height, width, 3) red, green, blue; the next one may overwrite it.

    Parameters
    ----------
    playback, film
        What is shown, and how.
    body
        Lengths of the robot; None where they are not known: it is an arrow then, and in MuJoCo's picture the shipped
        robot.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no pose is known in this part of the drive.
    sim.view.offscreen.NoOpenGLError
        If MuJoCo's picture is asked for and cannot be made.
    """
    times = film.times(playback)
    start, end = film.span(playback)
    first, last = playback.instants(np.array([start, end])).tolist()
    if not np.isfinite(playback.pose[first : last + 1]).all(axis=1).any():
        raise ConfigError(
            f"from {start:.1f} to {end:.1f} s the log knows no pose; choose another part by --from and --to"
        )
    with ExitStack() as stack:
        scenes: Iterator[Picture] | None = None
        if film.render or film.alone:
            size = film.size if film.alone else _scene_size(film.size)
            shown = body or robot_body()
            assert shown is not None
            scenes = stack.enter_context(painted(shots_of(playback, film, shown, size)))
        if film.alone:
            assert scenes is not None
            yield from scenes
            return
        with mpl.rc_context(_STYLE):
            page = _Page(playback, film, body)
        for time, pose in zip(times, playback.at(times), strict=True):
            yield page.at(float(time), pose, next(scenes) if scenes is not None else None)


def _scene_size(size: tuple[int, int]) -> tuple[int, int]:
    """Of MuJoCo's picture beside the view from above [pixels]."""
    return size[0] // 2 // 2 * 2, round(size[1] * (1 - _HEADER)) // 2 * 2


_HEADER = 0.12
"""Height of the line of words, as a share of the picture's."""


class _Page:
    """The parts of a picture, drawn once, with those that move on top."""

    def __init__(self, playback: Playback, film: Film, body: BodyShape | None) -> None:
        width, height = film.size
        self._playback, self._film = playback, film
        scale = min(height / _USUAL_HEIGHT, width / 1280)
        self._thickness = scale * 72.0 / _DPI * 1.2
        letters = _LETTERS * scale * 72.0 / _DPI
        mpl.rcParams.update({"font.size": letters, "legend.fontsize": 0.85 * letters, "axes.linewidth": 0.8})
        self._figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        span = film.span(playback)
        self._first, last = playback.instants(np.array(span)).tolist()
        shown = slice(self._first, last + 1)
        band = metric_settings().band
        plan_axes, charts = self._axes(film)
        self._curves = self._draw_charts(charts, shown, band, span)
        self._above = ViewFromAbove(plan_axes, playback, shown, band, body, self._thickness)
        if film.render:
            plan_axes.set(xlabel="", ylabel="x, y [m]")
            plan_axes.locator_params(nbins=3)
        self._legend(plan_axes, self._above.legend, 3)
        self._header()
        self._moving: list[Artist] = [*self._above.moving, *(one for part in self._curves for one in part.moving)]
        self._moving += [self._mode, self._message, self._clock]
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()  # type: ignore[no-untyped-call]
        self._rgba: Any = self._canvas.buffer_rgba()  # type: ignore[no-untyped-call]
        self._background: Any = self._canvas.copy_from_bbox(self._figure.bbox)  # type: ignore[no-untyped-call]

    def at(self, time: float, pose: FloatArray, scene: Picture | None) -> Picture:
        """The picture of this instant [s]."""
        k = int(self._playback.instants(np.array([time]))[0])
        self._canvas.restore_region(self._background)  # type: ignore[no-untyped-call]
        self._above.update(k, pose)
        for part in self._curves:
            part.update(k, self._first)
        self._say(k, time)
        for artist in self._moving:
            self._figure.draw_artist(artist)
        picture: Picture = np.asarray(self._rgba)[:, :, :3].copy()
        if scene is not None:
            picture[-scene.shape[0] :, : scene.shape[1]] = scene
        return picture

    def _axes(self, film: Film) -> tuple[Axes, list[Axes]]:
        """Axes of the view from above, and those of the curves from top to bottom."""
        top = 1.0 - _HEADER
        if film.render:
            # The curves below need the room of its labels.
            above = self._figure.add_axes((0.57, 0.455, 0.415, top - 0.535))
            return above, [self._figure.add_axes((0.595, 0.115, 0.39, 0.235))]
        above = self._figure.add_axes((0.065, 0.105, 0.455, top - 0.195))
        count = 3 if self._playback.position_error.size else 2
        gap, low, high = 0.055, 0.105, top - 0.06
        each = (high - low - (count - 1) * gap) / count
        places = [low + (count - 1 - i) * (each + gap) for i in range(count)]
        return above, [self._figure.add_axes((0.625, place, 0.36, each)) for place in places]

    def _draw_charts(self, charts: list[Axes], shown: slice, band: float, span: tuple[float, float]) -> list[Curves]:
        playback, thick, curves = self._playback, self._thickness, []
        if playback.position_error.size:
            curves.append(error_curves(charts[0], playback, band, shown, thick))
        curves += [
            speed_curves(axes, playback, channel, shown, thick) for channel, axes in enumerate(charts[len(curves) :])
        ]
        for axes in charts:
            axes.set_xlim(span[0], max(span[1], span[0] + 1e-3))
            axes.tick_params(labelbottom=axes is charts[-1])
            axes.yaxis.set_major_locator(MaxNLocator(4))
        charts[-1].set_xlabel("time [s]")
        for axes in charts[:2]:
            self._legend(axes, [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")], 3)
        return curves

    @staticmethod
    def _legend(axes: Axes, handles: Sequence[Line2D], columns: int) -> None:
        """Above the axes, in short rows."""
        axes.legend(
            handles=[_sample(handle) for handle in handles],
            loc="lower center",
            bbox_to_anchor=(0.5, 0.985),
            ncols=columns,
            frameon=False,
            borderpad=0.1,
            handlelength=1.4,
            columnspacing=1.0,
            handletextpad=0.5,
            labelspacing=0.2,
        )

    def _header(self) -> None:
        middle, letters = 1.0 - 0.5 * _HEADER, mpl.rcParams["font.size"]
        box = {"boxstyle": "round,pad=0.35", "linewidth": 0, "facecolor": GREEN}
        self._mode = self._figure.text(
            0.018, middle, "", color="white", weight="bold", va="center", size=1.1 * letters, bbox=box
        )
        self._message = self._figure.text(0.24, middle, "", va="center", size=0.92 * letters, linespacing=1.15)
        self._clock = self._figure.text(0.985, middle, "", va="center", ha="right", size=1.1 * letters)

    def _say(self, k: int, time: float) -> None:
        playback = self._playback
        words, colour = (
            ("log", BLUE) if not playback.modes else _WORDS.get(playback.modes[k], (playback.modes[k], BLUE))
        )
        self._mode.set_text(words)
        patch = self._mode.get_bbox_patch()
        assert patch is not None
        patch.set_facecolor(colour)
        message = playback.messages[k] if playback.messages else ""
        self._message.set_text("\n".join(textwrap.wrap(message, _MESSAGE_WIDTH, max_lines=2, placeholder=" ...")))
        times = "" if self._film.speed == 1.0 else f"   {self._film.speed:g}×"
        self._clock.set_text(f"{time:5.1f} s{times}")


def _sample(handle: Line2D) -> Line2D:
    """The line as a legend shows it: a wide one narrower."""
    wide = min(handle.get_linewidth(), 7.0)
    return Line2D(
        [],
        [],
        color=handle.get_color(),
        linestyle=handle.get_linestyle(),
        linewidth=wide,
        marker=handle.get_marker(),
        label=handle.get_label(),
    )
