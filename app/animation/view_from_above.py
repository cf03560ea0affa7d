"""The robot from above, with what it is to do and what it did, in axes of matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.bench.figure_style import PALETTE
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.body import BodyShape

BLUE, VERMILLION, GREEN, _, AMBER, SKY, _ = PALETTE
WAY, PLAN, ARRIVED, BAND = BLUE, VERMILLION, GREEN, "#CFE8F7"
_TYRE = "#222222"
_MARGIN = 1.0
"""Room around the path, in lengths of the robot."""
_UNKNOWN = 0.06
"""Length of the arrow for a robot of unknown size, as a share of the picture."""

Look = dict[str, Any]
"""Properties of an artist."""


class ViewFromAbove:
    """Draws what stays once, and gives the artists that move.

    Parameters
    ----------
    axes
        Where; they get equal scales.
    playback, shown
        The drive, and which of its instants.
    band, body
        Half the width of the strip along the path [m]; lengths of the robot, None where not known.
    thickness
        Of lines, 1.0 in a picture 720 pixels high.

    Attributes
    ----------
    moving
        The artists that `update` changes, in the order in which they are to be drawn.
    legend
        The lines that there are.
    """

    def __init__(
        self, axes: Axes, playback: Playback, shown: slice, band: float, body: BodyShape | None, thickness: float = 1.0
    ) -> None:
        self._playback, self._first = playback, shown.start
        axes.set_aspect("equal", adjustable="box")
        low, high = _extent(playback, shown)
        length = body.footprint[0] if body is not None else _UNKNOWN * float(np.max(high - low) + 0.5)
        axes.set(
            xlim=(low[0] - _MARGIN * length, high[0] + _MARGIN * length),
            ylim=(low[1] - _MARGIN * length, high[1] + _MARGIN * length),
            xlabel="x [m]",
            ylabel="y [m]",
        )
        axes.grid(visible=False)
        path = _draw_path(axes, playback.reference, band, thickness) if len(playback.reference) else []
        way = axes.plot([], [], color=WAY, linewidth=2.6 * thickness, label="driven")[0]
        dots: Look = {"linestyle": "none", "marker": ".", "markersize": 3.5 * thickness, "alpha": 0.55}
        arrived = axes.plot([], [], color=ARRIVED, **dots, label="poses measured")[0]
        plan = axes.plot([], [], color=PLAN, linewidth=3.6 * thickness, label="plan", solid_capstyle="round")[0]
        self._lines = way, arrived, plan
        shapes = _arrow(length) if body is None else _shapes(body)
        self._shapes = [(corners, Polygon(corners, **look)) for corners, look in shapes]
        for _, patch in self._shapes:
            axes.add_patch(patch)
        self.moving: list[Artist] = [arrived, way, *(patch for _, patch in self._shapes), plan]
        self.legend = [
            *path,
            way,
            *([arrived] if len(playback.arrived) else []),
            *([plan] if playback.plans.size else []),
        ]

    def update(self, k: int, pose: FloatArray) -> None:
        """Show instant `k` with the robot at `pose` (3,); one of NaN is not drawn."""
        playback = self._playback
        way, arrived, plan = self._lines
        so_far = slice(self._first, k + 1)
        passed = playback.pose[so_far]
        way.set_data(np.append(passed[:, 0], pose[0]), np.append(passed[:, 1], pose[1]))
        arrived.set_data(*playback.arrived[so_far, :2].T)
        if playback.plans.size:
            plan.set_data(*playback.plans[k, :, :2].T)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for corners, patch in self._shapes:
            patch.set_visible(bool(np.isfinite(pose).all()))
            patch.set_xy(pose[:2] + corners @ np.array([[c, s], [-s, c]]))


def _extent(playback: Playback, shown: slice) -> tuple[FloatArray, FloatArray]:
    points = np.concatenate([playback.pose[shown, :2], playback.reference[:, :2]])
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), points.max(axis=0)


def _draw_path(axes: Axes, reference: FloatArray, band: float, thickness: float) -> list[Line2D]:
    """The reference on its band: a line as thick as the band is wide, round where it bends."""
    axes.figure.canvas.draw()  # equal scales are settled only now
    box = axes.get_window_extent()
    pixels_per_metre = box.width / (axes.get_xlim()[1] - axes.get_xlim()[0])
    wide = 2 * band * pixels_per_metre * 72.0 / axes.figure.dpi
    caps: Look = {"solid_capstyle": "round", "solid_joinstyle": "round"}
    label = f"band ±{1000 * band:g} mm"
    strip = axes.plot(*reference[:, :2].T, color=BAND, linewidth=wide, zorder=1, label=label, **caps)
    line = axes.plot(*reference[:, :2].T, color="black", linewidth=1.4 * thickness, zorder=1.5, label="reference")
    return [*strip, *line]


def _shapes(body: BodyShape) -> list[tuple[FloatArray, Look]]:
    """Corners (k, 2) of wheels, box and front [m], in the robot's frame, with their looks."""
    length, width, _ = body.size
    tyre: Look = {"facecolor": _TYRE, "linewidth": 0}
    deck: Look = {"facecolor": BLUE, "edgecolor": "white", "linewidth": 0.8}
    wheels = [
        (_rectangle(2 * body.wheel_radius, body.wheel_width, x, y), tyre)
        for x in (body.wheel_base / 2, -body.wheel_base / 2)
        for y in (body.track / 2, -body.track / 2)
    ]
    front = _rectangle(0.1 * length, 0.7 * width, 0.4 * length, 0.0)
    return [*wheels, (_rectangle(length, width, 0.0, 0.0), deck), (front, {"facecolor": AMBER, "linewidth": 0})]


def _arrow(length: float) -> list[tuple[FloatArray, Look]]:
    tip = length * np.array([(0.6, 0.0), (-0.4, 0.35), (-0.2, 0.0), (-0.4, -0.35)])
    return [(tip, {"facecolor": BLUE, "edgecolor": "white", "linewidth": 0.8})]


def _rectangle(length: float, width: float, x: float, y: float) -> FloatArray:
    half = 0.5 * np.array([(length, width), (-length, width), (-length, -width), (length, -width)])
    return np.asarray(half + np.array([x, y]))
