"""Tables in the terminal."""

from __future__ import annotations

import math
from typing import Literal

from rich import box
from rich.table import Table as RichTable
from rich.text import Text

from diffdrive_mpc.models import table as plain
from diffdrive_mpc.models.plain_text import plain_line
from diffdrive_mpc.models.table import number

__all__ = ["Table", "duration", "number", "rich_table"]

_ABBREVIATIONS = {
    "position": "pos.",
    "heading": "head.",
    "lateral": "lat.",
    "deadline misses": "late",
    "fallbacks": "fall-backs",
    "completed": "done",
    "trajectory": "path",
}
"""Words that would make columns too wide for a terminal of 80 characters."""


class Table(plain.Table):
    """A table that the terminal draws."""

    def rich(self) -> RichTable:
        """The table for the terminal."""
        return rich_table(self)


def rich_table(table: plain.Table) -> RichTable:
    """A table for the terminal."""
    drawn = RichTable(
        title=Text(table.title, style="bold"),
        caption=Text(table.note) if table.note else None,
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
        collapse_padding=True,
        pad_edge=False,
        show_edge=False,
    )
    for i, heading in enumerate(table.columns):
        numeric = i >= table.text_columns
        # Headings and sentences may break in a narrow terminal, numbers and names must not.
        longest = max((len(row[i]) for row in table.rows), default=0)
        least = longest if numeric or longest <= 10 else None
        justify: Literal["left", "right"] = "right" if numeric else "left"
        drawn.add_column(Text(_brief(heading)), justify=justify, min_width=least, overflow="fold")
    for row in table.rows:
        drawn.add_row(*(Text(plain_line(cell)) for cell in row))
    return drawn


def duration(seconds: float) -> str:
    """A cell for a time [s]; "∞" for never, "-" where there is none."""
    return "∞" if seconds == math.inf else number(seconds, 2)


def _brief(heading: str) -> str:
    for word, short in _ABBREVIATIONS.items():
        heading = heading.replace(word, short)
    return heading
