"""The look that all figures share."""

from __future__ import annotations

import itertools
import re
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart with every kind of colour vision, and by brightness in print.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINE_STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
REFERENCE_COLOUR = "#7F7F7F"
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
    """Give a figure of `width` x `height` inches to draw on, and save it to `path`."""
    with mpl.rc_context(_SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        # No date and no software version: the same run gives the same file.
        figure.savefig(path, metadata={"Software": None})


def colour(index: int) -> str:
    """Colour of the series number `index`; it repeats after seven."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> str:
    """Line style of the series number `index`, so that lines are told apart without colour."""
    return LINE_STYLES[index % len(LINE_STYLES)]


def boxed_legend(axes: Axes) -> None:
    """Legend in one row that stays readable where it lies on lines."""
    axes.legend(ncols=4, loc="upper right", frameon=True, framealpha=0.8, edgecolor="none", borderpad=0.2)


def file_name(text: str) -> str:
    """A name that every file system takes: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-")


def free_name(text: str, taken: Container[str]) -> str:
    """File name of a figure called `text`, with a number where another one has that name already."""
    stem = file_name(text)
    names = itertools.chain([f"{stem}.png"], (f"{stem}-{number}.png" for number in itertools.count(2)))
    return next(name for name in names if name not in taken)
