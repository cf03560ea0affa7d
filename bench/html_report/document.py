"""Page as a single HTML file that contains the content as JSON, the style, the scripts and the plotting library."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

from diffdrive_mpc.bench.chart_look import DASHES, PALETTE
from diffdrive_mpc.bench.html_report.page import Chart, EmbeddedPicture, Page, RunViews, View
from diffdrive_mpc.bench.html_report.plotly_figures import chart_figure, map_figure, run_figures
from diffdrive_mpc.bench.plain_values import plain

_TEMPLATE = Path(__file__).parent / "template"
_SCRIPTS = ("text.js", "views.js")


def write_page(page: Page, path: Path) -> None:
    """Write a page to `path`."""
    path.write_text(page_text(page), encoding="utf-8")


def page_text(page: Page) -> str:
    """Render the page as HTML; the result depends on the page only."""
    parts = {
        "title": page.title.replace("&", "&amp;").replace("<", "&lt;"),
        "style": _file("page.css"),
        "content": json_text(content(page)),
        "plotly": _plotly(),
        "script": "\n".join(map(_file, _SCRIPTS)),
    }
    return Template(_file("page.html")).substitute(parts)


def content(page: Page) -> dict[str, Any]:
    """Collect the data of the scripts: the page as plain values, and the common style of the figures."""
    shown: dict[str, Any] = plain(replace(page.shown, views=[_view(view) for view in page.shown.views]))
    tables = [
        {
            "title": table.title,
            "columns": table.columns,
            "rows": table.rows,
            "note": table.note,
            "text_columns": table.text_columns,
        }
        for table in page.tables
    ]
    look = {"colours": PALETTE, "dashes": DASHES}
    page_values: dict[str, Any] = plain(
        {"command": page.command, "title": page.title, "tables": tables, "origin": page.origin, "look": look}
    )
    return shown | page_values


def json_text(values: Mapping[str, object]) -> str:
    """Format `values` as JSON that cannot close the surrounding script element."""
    text = json.dumps(values, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def picture(path: Path) -> str:
    """Encode a PNG file as a data URL."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def _view(view: View) -> Any:  # noqa: ANN401 - a picture, or the plain values of another view
    if isinstance(view, EmbeddedPicture):
        return view
    if isinstance(view, RunViews):
        return {"kind": view.kind, "note": view.note, **run_figures(view)}
    figure = chart_figure(view) if isinstance(view, Chart) else map_figure(view)
    return {"kind": view.kind, "title": view.title, "note": view.note, "broad": view.broad, "figure": figure}


@cache
def _file(name: str) -> str:
    return (_TEMPLATE / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 - loads slowly

    text: str = get_plotlyjs()
    return text
