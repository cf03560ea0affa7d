"""Common style of all figures."""

from __future__ import annotations

import itertools
import re
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from diffdrive_mpc.bench.chart_look import LINE_STYLES, MARKERS, PALETTE, REFERENCE_COLOUR

__all__ = [
    "ERROR_MAP",
    "LINE_STYLES",
    "MARKERS",
    "PALETTE",
    "REFERENCE_COLOUR",
    "colour",
    "file_name",
    "free_name",
    "line_style",
    "new_figure",
]

ERROR_MAP = "cividis"

_SETTINGS: Any = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "savefig.dpi": 150,
    "svg.hashsalt": "diffdrive-mpc",
}


@contextmanager
def new_figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield a figure of `width` x `height` inches and save it to `path` afterwards."""
    with mpl.rc_context(_SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        # Omit date and software version, so that equal runs produce equal files.
        figure.savefig(path, metadata={"Software": None})


def colour(index: int) -> str:
    """Return the colour of series number `index`; the colours repeat after seven series."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> str:
    """Return the line style of series number `index`; it distinguishes the lines in a print without colour."""
    return LINE_STYLES[index % len(LINE_STYLES)]


def file_name(text: str) -> str:
    """Convert text to a name that is valid on every file system: lower case, with words joined by hyphens."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-")


def free_name(text: str, used: Container[str]) -> str:
    """Return a file name for a figure titled `text`, with a number if the name is in `used`."""
    stem = file_name(text)
    names = itertools.chain([f"{stem}.png"], (f"{stem}-{number}.png" for number in itertools.count(2)))
    return next(name for name in names if name not in used)
