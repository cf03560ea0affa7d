"""Contents of a report as plain values, which the scripts in `template/` draw."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import TextTable

Labels = Mapping[str, str]
"""Values of the toggles that show or hide an element, by name of the toggle."""


Division = Literal["linear", "log", "category"]
"""Scale of an axis."""


@dataclass(frozen=True)
class KeyFigure:
    """Prominent value of the summary; `state` rates the value, or is empty."""

    label: str
    value: str
    note: str = ""
    state: Literal["", "good", "bad"] = ""


@dataclass(frozen=True)
class PageWarning:
    """Text of a warning and its remedy."""

    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Toggle:
    """Group of buttons, each of which shows or hides elements.

    Attributes
    ----------
    name
        Name of the quantity.
    values
        Values of the quantity, one button each.
    shown
        Values that are selected when the page is opened.
    styled
        True if value i is drawn in style i.
    """

    name: str
    values: tuple[str, ...]
    shown: tuple[str, ...]
    styled: bool = False


@dataclass(frozen=True)
class Axis:
    """Axis of a chart: title with unit, scale, and range."""

    title: str
    type: Division = "linear"
    range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Series:
    """Points of a chart that are drawn in one style.

    Attributes
    ----------
    name
        Name in the legend.
    x, y
        Coordinates of the points.
    style
        Index of the colour, the line style and the marker.
    kind
        Kind of drawing: `rows` are horizontal bars that are labelled by `y`; `steps` keep each y up to the next x.
    low, high
        Bounds of an interval that contains each y; empty for no intervals.
    text
        Text of the tooltip at each point; if empty, the tooltip shows the coordinates.
    labels
        Values of the toggles that show or hide the series.
    group
        Name of the run; all series of a group have points at the same ticks.
    """

    name: str
    x: Sequence[float | str | None]
    y: Sequence[float | str | None]
    style: int = 0
    kind: Literal["both", "line", "points", "bars", "rows", "steps", "reference"] = "both"
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    text: Sequence[str] = ()
    labels: Labels = field(default_factory=dict)
    group: str = ""


@dataclass(frozen=True)
class Mark:
    """Labelled horizontal line at a value of y; if `upright`, vertical line at a value of x."""

    value: float
    text: str
    upright: bool = False


@dataclass(frozen=True)
class Chart:
    """Series in a coordinate system.

    A `broad` chart has the width of the page; `height` is in pixels; `equal` gives x and y the same scale.
    """

    title: str
    x: Axis
    y: Axis
    series: Sequence[Series]
    note: str = ""
    marks: Sequence[Mark] = ()
    broad: bool = False
    height: int = 340
    equal: bool = False
    kind: Literal["chart"] = "chart"


@dataclass(frozen=True)
class GridAxis:
    """Values along one axis of a map."""

    title: str
    values: Sequence[float]
    type: Division = "linear"


@dataclass(frozen=True)
class GridMap:
    """Map of a value [unit] over x and y, with a row for each y; a cell for which `crossed` is true shows a cross."""

    title: str
    x: GridAxis
    y: GridAxis
    values: Sequence[Sequence[float | None]]
    unit: str
    crossed: Sequence[Sequence[bool]]
    note: str = ""
    broad: bool = False
    kind: Literal["map"] = "map"


@dataclass(frozen=True)
class EmbeddedPicture:
    """Picture embedded in the page; `source` is a data URL, see `document.picture`."""

    title: str
    source: str
    note: str = ""
    broad: bool = True
    kind: Literal["picture"] = "picture"


@dataclass(frozen=True)
class RunSeries:
    """Series of a closed-loop run: in the plane, and over time by title of the pane."""

    name: str
    plane: Sequence[Series]
    panes: Mapping[str, Sequence[Series]]
    marks: Mapping[str, Sequence[Mark]] = field(default_factory=dict)

    def in_style(self, style: int) -> RunSeries:
        """Return a copy of the run with all series but the references in `style`."""
        plane = _in_style(self.plane, style)
        return replace(self, plane=plane, panes={title: _in_style(pane, style) for title, pane in self.panes.items()})


def _in_style(series: Sequence[Series], style: int) -> list[Series]:
    return [entry if entry.kind == "reference" else replace(entry, style=style) for entry in series]


@dataclass(frozen=True)
class RunViews:
    """Linked charts of closed-loop runs; see `run_series.run_series`."""

    runs: Sequence[RunSeries]
    note: str = ""
    kind: Literal["runs"] = "runs"

    @property
    def plane(self) -> Chart:
        """Chart of the paths in the plane."""
        series = _references_once(entry for run in self.runs for entry in run.plane)
        return Chart("Path in the plane", Axis("x [m]"), Axis("y [m]"), series, height=460, equal=True)

    @property
    def panes(self) -> list[Chart]:
        """Charts over time, in order from top to bottom."""
        titles = dict.fromkeys(title for run in self.runs for title in run.panes)
        return [
            Chart(
                title,
                Axis("time [s]"),
                Axis(title),
                _references_once(entry for run in self.runs for entry in run.panes.get(title, ())),
                marks=self.runs[0].marks.get(title, ()),
            )
            for title in titles
        ]


def _references_once(series: Iterable[Series]) -> list[Series]:
    """Remove references with the name and labels of an earlier reference, because runs on one path share it."""
    entries: dict[object, Series] = {}
    for entry in series:
        is_reference = entry.kind == "reference"
        entries.setdefault((entry.name, *entry.labels.items()) if is_reference else id(entry), entry)
    return list(entries.values())


View = Chart | GridMap | EmbeddedPicture | RunViews


@dataclass(frozen=True)
class ConfigurationView:
    """Text of a configuration that was used."""

    name: str
    text: str

    @classmethod
    def of_files(cls, folder: Path, files: Mapping[str, str]) -> list[ConfigurationView]:
        """Return views of those `files` that exist in a folder; `files` are titles by file name."""
        paths = {f"{title}: {name} (YAML)": folder / name for name, title in files.items()}
        return [cls(title, path.read_text(encoding="utf-8")) for title, path in paths.items() if path.is_file()]


@dataclass(frozen=True)
class PageContents:
    """Contents of a report other than its tables and its origin.

    Attributes
    ----------
    summary, notes
        Sentences at the top of the page (completion, quality and comparison), and explanations of terms in small type.
    key_figures
        Key figures of the summary.
    toggles
        Buttons that act on all views.
    views
        Views in order; adjacent charts are placed side by side.
    warnings
        Warnings in descending order of severity.
    configurations
        Configurations of the controllers.
    pictures
        True if the page also contains the pictures of the Markdown report.
    """

    summary: Sequence[str] = ()
    notes: Sequence[str] = ()
    key_figures: Sequence[KeyFigure] = ()
    toggles: Sequence[Toggle] = ()
    views: Sequence[View] = ()
    warnings: Sequence[PageWarning] = ()
    configurations: Sequence[ConfigurationView] = ()
    pictures: bool = True


NO_CONTENTS = PageContents()
"""Empty contents for a report with tables and pictures only."""


@dataclass(frozen=True)
class Origin:
    """Origin of a run: the exact command, and facts such as version, computer and seeds as name and value."""

    command: str
    facts: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Page:
    """Complete report."""

    command: str
    title: str
    shown: PageContents
    tables: Sequence[TextTable]
    origin: Origin


# Charts contain rounded values, at most as many as can be distinguished on a screen.


_TAIL_POINTS = 120


def from_zero(time: FloatArray) -> tuple[FloatArray, str]:
    """Return the times (n,) relative to the first time [s], and the title of the axis, which states the first time."""
    start = float(time[0]) if len(time) else 0.0
    since = f" since {start:.2f} s on the log's clock" if start else ""
    return time - start, f"time [s]{since}"


def round_digits(value: float) -> float | None:
    """Round a number to four significant digits; return None if the number is not finite."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


def tail_shares(values: Sequence[float] | FloatArray) -> tuple[list[float], list[float | None]]:
    """Return sorted values and the share of larger values, sampled evenly in the logarithm of the share."""
    ordered = np.sort(np.asarray(values, dtype=float))
    indices = np.unique(ordered.size - np.geomspace(1, ordered.size, _TAIL_POINTS).round().astype(int))
    return [float(f"{value:.4g}") for value in ordered[indices]], [
        round_digits(1.0 - k / ordered.size) for k in indices
    ]
