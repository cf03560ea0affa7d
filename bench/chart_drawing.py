"""Drawing of the charts of a report as PNG files, from the same description as the charts of the HTML page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple

from diffdrive_mpc.bench.chart_look import marker_number
from diffdrive_mpc.bench.figure_style import ERROR_MAP, MARKERS, REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.page import Chart, GridMap, Mark, RunViews, Series
from diffdrive_mpc.models.interface import FloatArray

_WIDTH, _HEIGHT, _LEGEND_ROW = 4.6, 3.4, 0.22
"""Width and height of a chart, and height of a legend row [inches]."""
_NAMES_IN_A_ROW = 3
_DENSE = 100
"""Minimum number of points of a series for small markers."""
HATCHES = ("", "//", "..", "\\\\", "xx", "--", "++")
_BARS = 0.84
"""Total width of the bars of a category as a share of the distance between two categories [-]."""


def draw_charts(
    charts: Sequence[Chart | GridMap], path: Path, width: float = _WIDTH, columns: int | None = None
) -> None:
    """Draw charts with a width of `width` [inches] each into the PNG file `path`.

    A row has `columns` charts, by default all charts. A common legend is below the charts.
    """
    columns = columns or len(charts)
    names = {entry.name: None for chart in charts if isinstance(chart, Chart) for entry in chart.series}
    legend_rows = -(-len(names) // (_NAMES_IN_A_ROW * columns)) if len(names) > 1 else 0
    rows = -(-len(charts) // columns)
    with new_figure(path, width * columns, _HEIGHT * rows + _LEGEND_ROW * legend_rows) as figure:
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes in panels[len(charts) :]:
            axes.set_visible(False)
        for axes, chart in zip(panels, charts, strict=False):
            if isinstance(chart, GridMap):
                mesh = draw_map(axes, chart)
                figure.colorbar(mesh, ax=axes, label=chart.unit)
            else:
                draw_chart(axes, chart)
            axes.set_title(chart.title)
        if legend_rows:
            _legend(figure, panels, min(len(names), _NAMES_IN_A_ROW * columns))


def draw_run(views: RunViews, title: str, path: Path, draw_more: Callable[[Axes], None] = lambda _: None) -> None:
    """Draw the paths of runs in the plane and their time series into the PNG file `path`.

    `draw_more` draws additional elements into the axes of the plane.
    """
    panes = views.panes
    with new_figure(path, 9.6, 6.4) as figure:
        grid = figure.add_gridspec(len(panes), 2, width_ratios=(1.1, 1.0))
        plane = figure.add_subplot(grid[:, 0])
        draw_chart(plane, views.plane)
        draw_more(plane)
        right = [figure.add_subplot(grid[row, 1]) for row in range(len(panes))]
        for axes, chart in zip(right, panes, strict=True):
            draw_chart(axes, chart)
        for axes in right[:-1]:
            axes.sharex(right[-1])
            axes.tick_params(labelbottom=False)
            axes.set_xlabel("")
        figure.align_ylabels(right)
        figure.suptitle(title)
        _legend(figure, (plane, *right), 6)


def _legend(figure: Figure, panels: Sequence[Axes], columns: int) -> None:
    """Add a legend that shows the bars and the lines of each name side by side."""
    handles: dict[str, dict[type, Any]] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, {}).setdefault(type(handle), handle)
    shown: list[Any] = [tuple(kinds.values()) for kinds in handles.values()]
    beside = {tuple: HandlerTuple(ndivide=None)}
    figure.legend(shown, list(handles), handler_map=beside, loc="outside lower center", ncols=columns)


def draw_chart(axes: Axes, chart: Chart) -> None:
    """Draw the series and marks of a chart, without the title."""
    categories = _categories(chart)
    bars = [entry for entry in chart.series if entry.kind in ("bars", "rows")]
    for series in chart.series:
        if series.kind in ("bars", "rows"):
            _draw_bars(axes, series, bars.index(series), len(bars), categories)
        else:
            _draw_points(axes, series, categories)
    if chart.series and chart.series[0].kind == "rows":
        axes.set_yticks(range(len(categories)), categories)
        axes.invert_yaxis()
    elif categories:
        angle = 20 if sum(map(len, categories)) > 40 else 0
        axes.set_xticks(range(len(categories)), categories, rotation=angle, ha="right" if angle else "center")
    for axis, scale in ((chart.x, axes.set_xscale), (chart.y, axes.set_yscale)):
        if axis.type == "log":
            scale("log")
    for mark in chart.marks:
        _draw_mark(axes, mark)
    axes.set(xlabel=chart.x.title, ylabel=chart.y.title)
    if chart.equal:
        axes.set_aspect("equal")
        return
    if chart.y.range is not None:
        axes.set_ylim(chart.y.range)
    elif chart.y.type == "linear" and axes.get_ylim()[0] > 0.0:
        axes.set_ylim(bottom=0.0)


def _draw_mark(axes: Axes, mark: Mark) -> None:
    style: Any = {"textcoords": "offset points", "fontsize": 8.0, "color": REFERENCE_COLOUR}
    line = axes.axvline if mark.upright else axes.axhline
    line(mark.value, color=REFERENCE_COLOUR, linestyle=":", linewidth=1.2)
    if mark.upright:
        position, offset = (mark.value, 0.98), (-2, 0)
        axes.annotate(
            mark.text, position, offset, ("data", "axes fraction"), ha="right", va="top", rotation=90, **style
        )
    else:
        position, offset = (0.01, mark.value), (0, 1)
        axes.annotate(mark.text, position, offset, ("axes fraction", "data"), ha="left", va="bottom", **style)


def draw_map(axes: Axes, chart: GridMap) -> Any:  # noqa: ANN401 - argument of Figure.colorbar
    """Draw a map with logarithmic colours and a cross at each marked cell; return the mesh for a colour bar."""
    values = _numbers([value for row in chart.values for value in row]).reshape(len(chart.values), -1)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    norm = LogNorm(low, max(high, 1.001 * low))
    mesh = axes.pcolormesh(chart.x.values, chart.y.values, values, norm=norm, cmap=ERROR_MAP, shading="nearest")
    for row, column in np.argwhere(np.array(chart.crossed)):
        axes.plot(chart.x.values[column], chart.y.values[row], "X", color="white", markeredgecolor="black")
    axes.set(xlabel=chart.x.title, ylabel=chart.y.title, xscale=chart.x.type, yscale=chart.y.type)
    axes.grid(visible=False)
    return mesh


def _categories(chart: Chart) -> list[str]:
    """Return the names along a categorical axis in the order of first appearance."""
    rows = any(entry.kind == "rows" for entry in chart.series)
    if not rows and chart.x.type != "category":
        return []
    names = (value for entry in chart.series for value in (entry.y if rows else entry.x))
    return list(dict.fromkeys(map(str, names)))


def _draw_bars(axes: Axes, series: Series, position: int, count: int, categories: Sequence[str]) -> None:
    width = _BARS / count
    names, lengths = (series.y, series.x) if series.kind == "rows" else (series.x, series.y)
    places = np.array([categories.index(str(name)) for name in names]) + (position - (count - 1) / 2) * width
    values = np.nan_to_num(_numbers(lengths))
    style: dict[str, Any] = {
        "color": colour(series.style),
        "hatch": HATCHES[marker_number(series.style)],
        "edgecolor": "white",
        "alpha": 0.85,
        "label": series.name,
    }
    ends = _interval(series, values)
    if series.kind == "rows":
        axes.barh(places, values, 0.92 * width, xerr=ends, **style)
        axes.grid(axis="y", visible=False)
    else:
        axes.bar(places, values, 0.92 * width, yerr=ends, capsize=2, **style)
        axes.grid(axis="x", visible=False)


def _draw_points(axes: Axes, series: Series, categories: Sequence[str]) -> None:
    x = [categories.index(str(value)) for value in series.x] if categories else _numbers(series.x)
    if series.kind == "steps":
        axes.step(x, list(map(str, series.y)), where="post", color=colour(series.style))
        return
    y = _numbers(series.y)
    style: dict[str, Any] = {"color": colour(series.style), "label": series.name}
    style["linestyle"] = "none" if series.kind == "points" else line_style(series.style)
    if series.kind == "reference":
        style |= {"color": REFERENCE_COLOUR, "linestyle": ":", "linewidth": 2.0}
    elif series.kind != "line":
        size = 4.0 if len(series.x) < _DENSE else 1.5
        style |= {"marker": MARKERS[marker_number(series.style)], "markersize": size}
    axes.errorbar(x, y, yerr=_interval(series, y), capsize=3, **style)


def _interval(series: Series, values: FloatArray) -> FloatArray | None:
    """Compute the lengths (2, n) of the interval below and above each value; None if the series has no interval."""
    if not len(series.low):
        return None
    return np.asarray(np.abs([values - _numbers(series.low), _numbers(series.high) - values]))


def _numbers(values: Sequence[float | str | None]) -> FloatArray:
    return np.array([np.nan if value is None else float(value) for value in values])
