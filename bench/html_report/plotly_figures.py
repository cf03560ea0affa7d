"""Charts of a page as Plotly figures, whose `data` and `layout` consist of plain values."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from diffdrive_mpc.bench.chart_look import DASHES, PALETTE, PLOTLY_MARKERS, REFERENCE_COLOUR, marker_number
from diffdrive_mpc.bench.html_report.page import Axis, Chart, GridMap, Mark, RunViews, Series

_GRID = {"gridcolor": "#e6ebef", "zerolinecolor": "#c5ced6", "linecolor": "#c5ced6", "automargin": True}
_MARK_GREY = "#5a6875"
_LAYOUT: dict[str, Any] = {
    "font": {"family": "system-ui, Segoe UI, Roboto, DejaVu Sans, sans-serif", "size": 12, "color": "#1b2733"},
    "plot_bgcolor": "#fff",
    "margin": {"l": 56, "r": 40, "t": 30, "b": 48},
    "modebar": {"orientation": "v", "bgcolor": "rgba(255,255,255,0)"},
    "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 11}},
    "hovermode": "closest",
    "barmode": "group",
}
_PATTERNS = ("", "/", ".", "x", "-")
_PANE_HEIGHT = 150
"""Height of a pane of a run [pixels]."""
_MIN_DENSE_POINTS = 100
"""Minimum number of points of a series that is drawn with small markers."""
_MODES = {"points": "markers", "both": "lines+markers"}


def escape(text: str) -> str:
    """Escape tags for Plotly, but not quotes, because Plotly shows their entities as text."""
    return html.escape(text, quote=False)


def chart_figure(chart: Chart) -> dict[str, Any]:
    """Build the figure of a chart."""
    axes = {"xaxis": _axis(chart.x), "yaxis": _axis(chart.y)}
    if chart.equal:
        axes["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    if any(series.kind == "rows" for series in chart.series):
        axes["yaxis"]["autorange"] = "reversed"
    return {
        "data": [_trace(series) for series in chart.series],
        "layout": _LAYOUT
        | axes
        | {"height": chart.height, "shapes": [_shape(mark, "y") for mark in chart.marks]}
        | {"showlegend": len(chart.series) > 1},
    }


def map_figure(grid: GridMap) -> dict[str, Any]:
    """Build the figure of a map with a logarithmic colour scale."""
    values = np.array(grid.values, dtype=float)
    logarithms = np.log10(np.where(values > 0.0, values, np.nan))
    low, high = float(np.nanmin(logarithms)), float(np.nanmax(logarithms))
    ticks = np.linspace(low, high, 5)
    trace = {
        "type": "heatmap",
        "x": list(grid.x.values),
        "y": list(grid.y.values),
        "z": logarithms,
        "customdata": values,
        "text": [["×" if is_crossed else "" for is_crossed in row] for row in grid.crossed],
        "texttemplate": "%{text}",
        "textfont": {"size": 16, "color": "#fff"},
        "colorscale": "Cividis",
        "colorbar": {
            "title": {"text": escape(grid.unit), "side": "right"},
            "thickness": 12,
            "tickvals": ticks,
            "ticktext": [f"{10.0**tick:.2g}" for tick in ticks],
        },
        "hovertemplate": f"{escape(grid.x.title)}: %{{x}}<br>{escape(grid.y.title)}: %{{y}}<br>"
        f"%{{customdata}} {escape(grid.unit)}<extra></extra>",
        "meta": {"labels": {}, "group": ""},
    }
    axes = {f"{name}axis": _axis(Axis(axis.title, axis.type)) for name, axis in (("x", grid.x), ("y", grid.y))}
    return {"data": [trace], "layout": _LAYOUT | axes | {"height": 360}}


def panes_figure(views: RunViews) -> dict[str, Any]:
    """Build the figure of the charts over time: panes with a common time axis."""
    panes = views.panes
    names = ["y", *(f"y{number}" for number in range(2, len(panes) + 1))]
    named_panes = list(zip(names, panes, strict=True))
    axes = {f"yaxis{name[1:]}": _axis(pane.y) | {"nticks": 5} for name, pane in named_panes}
    is_single = len(views.runs) == 1
    pane_series = [(name, series) for name, pane in named_panes for series in pane.series]
    first_index = {series.name: index for index, (_, series) in reversed([*enumerate(pane_series)])}
    traces = [
        # A name that occurs in several panes has one legend entry.
        _trace(series)
        | {"yaxis": name, "legendgroup": escape(series.name), "showlegend": first_index[series.name] == index}
        for index, (name, series) in enumerate(pane_series)
    ]
    return {
        "data": traces,
        "layout": _LAYOUT
        | axes
        | {
            "xaxis": _axis(Axis("time [s]")),
            "grid": {"rows": len(panes), "columns": 1, "subplots": [[f"x{name}"] for name in names], "ygap": 0.15}
            | {"xside": "bottom plot"},
            "height": _PANE_HEIGHT * len(panes),
            "shapes": [_shape(mark, name) for name, pane in named_panes for mark in pane.marks],
            "showlegend": is_single,
            # One tooltip shows the values of all panes at the same time.
            "hovermode": "x unified" if is_single else "closest",
            "hoversubplots": "axis" if is_single else "overlaying",
        },
    }


def run_figures(views: RunViews) -> dict[str, Any]:
    """Build the figures of linked views: the plane and the panes over time."""
    plane = chart_figure(views.plane)
    plane["layout"] |= {"showlegend": len(views.runs) == 1}
    return {"plane": plane, "times": panes_figure(views), "runs": [run.name for run in views.runs]}


def _axis(axis: Axis) -> dict[str, Any]:
    limits = {} if axis.range is None else {"range": list(axis.range)}
    kind = {} if axis.type == "linear" else {"type": axis.type}
    return _GRID | {"title": {"text": escape(axis.title), "standoff": 8}, "exponentformat": "none"} | kind | limits


def _trace(series: Series) -> dict[str, Any]:
    colour = PALETTE[series.style % len(PALETTE)]
    trace: dict[str, Any] = {
        "name": escape(series.name),
        "x": list(series.x),
        "y": list(series.y),
        "meta": {"labels": dict(series.labels), "group": series.group},
    }
    if series.text:
        trace |= {"text": [escape(text) for text in series.text], "hovertemplate": "%{text}<extra></extra>"}
    if series.kind in ("bars", "rows"):
        pattern = {"shape": _PATTERNS[series.style % len(_PATTERNS)], "fillmode": "overlay", "fgcolor": "#fff"}
        marker = {"color": colour, "pattern": pattern | {"size": 6, "solidity": 0.25}}
        return trace | {"type": "bar", "orientation": "h" if series.kind == "rows" else "v", "marker": marker}
    line = {"color": colour, "dash": DASHES[series.style % len(DASHES)], "width": 1.8}
    if series.kind == "reference":
        line = {"color": REFERENCE_COLOUR, "dash": "dot", "width": 1.6}
    if series.kind == "steps":
        line["shape"] = "hv"
    symbol = PLOTLY_MARKERS[marker_number(series.style)]
    trace |= {"type": "scatter", "mode": _MODES.get(series.kind, "lines"), "line": line}
    trace["marker"] = {
        "color": colour,
        "symbol": symbol,
        "size": 7 if len(series.x) < _MIN_DENSE_POINTS else 3,
        "line": {"color": "#fff", "width": 1},
    }
    return trace | ({"error_y": _interval(series)} if len(series.low) else {})


def _interval(series: Series) -> dict[str, Any]:
    y = np.array(series.y, dtype=float)
    distances = {"array": np.array(series.high, dtype=float) - y, "arrayminus": y - np.array(series.low, dtype=float)}
    return {"type": "data", "symmetric": False, "thickness": 1.2} | distances


def _shape(mark: Mark, y: str) -> dict[str, Any]:
    ends: Sequence[Any] = (mark.value, mark.value)
    value_axis, line_axis = ("x", "y") if mark.upright else ("y", "x")
    line = {f"{value_axis}0": ends[0], f"{value_axis}1": ends[1], f"{line_axis}0": 0, f"{line_axis}1": 1}
    domains = {"xref": "x" if mark.upright else "x domain", "yref": f"{y} domain" if mark.upright else y}
    label = {"text": escape(mark.text), "textposition": "end", "font": {"size": 11, "color": _MARK_GREY}}
    return {"type": "line", "line": {"color": _MARK_GREY, "dash": "dot", "width": 1.5}, "label": label} | line | domains
