"""Errors, commands and speeds over time, drawn as far as the drive has come."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.app.animation.view_from_above import BAND, BLUE, VERMILLION
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR
from diffdrive_mpc.models.interface import FloatArray

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
