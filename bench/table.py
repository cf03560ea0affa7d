"""Tables in the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from diffdrive_mpc.models import table as plain
from diffdrive_mpc.models.table import number, plain_line

__all__ = ["RichTables", "Table", "duration", "millis", "number", "rich_table"]

_ABBREVIATIONS = {
    "position": "pos.",
    "heading": "head.",
    "lateral": "lat.",
    "deadline misses": "late",
    "fallbacks": "fall-backs",
    "completed": "done",
    "trajectory": "path",
}
"""Abbreviations of words that make columns too wide for a terminal of 80 characters."""
_GAP = 2
"""Number of characters between two columns."""


class Table(plain.TextTable):
    """Table that can be rendered in the terminal."""

    def rich(self) -> RichTables:
        """Build the table for the terminal."""
        return rich_table(self)


@dataclass(frozen=True)
class RichTables:
    """Table that Rich renders in the width of the console.

    Texts and headings are wrapped. Columns of numbers that do not fit are placed in further tables, which repeat the
    columns of names.
    """

    table: plain.TextTable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the parts from top to bottom."""
        parts = self._parts(options.max_width)
        for i, columns in enumerate(parts):
            if i > 0:
                yield Text()
            yield self._part(columns, is_first=i == 0, is_last=i == len(parts) - 1)

    def _parts(self, width: int) -> list[list[int]]:
        """Distribute the columns to parts of at most `width` characters."""
        names = list(range(self.table.text_columns))
        parts = [names]
        width_of_numbers = width - min(sum(self._min_width(i) + _GAP for i in names), width // 2)
        remaining = width_of_numbers
        for i in range(len(names), len(self.table.columns)):
            needed = self._min_width(i) + _GAP
            if needed > remaining and len(parts[-1]) > len(names):
                parts.append(names)
                remaining = width_of_numbers
            parts[-1] = [*parts[-1], i]
            remaining -= needed
        return parts

    def _min_width(self, column: int) -> int:
        """Return the width of a column's longest word or number, which must not be broken."""
        is_number = column >= self.table.text_columns
        cells = [plain_line(row[column]) for row in self.table.rows]
        words = [word for cell in (_brief(self.table.columns[column]), *cells) for word in cell.split()]
        return max(map(cell_len, [*words, *(cells if is_number else [])]), default=0)

    def _part(self, columns: Sequence[int], *, is_first: bool, is_last: bool) -> RichTable:
        table = self.table
        part = RichTable(
            title=Text(table.title, style="bold") if is_first else None,
            caption=Text(table.note) if is_last and table.note else None,
            title_justify="left",
            caption_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1),
            collapse_padding=True,
            pad_edge=False,
            show_edge=False,
        )
        for column in columns:
            is_number = column >= table.text_columns
            justify: Literal["left", "right"] = "right" if is_number else "left"
            min_width = self._min_width(column) if is_number else None
            part.add_column(Text(_brief(table.columns[column])), justify=justify, min_width=min_width, overflow="fold")
        for row in table.rows:
            part.add_row(*(Text(plain_line(row[column])) for column in columns))
        return part


def rich_table(table: plain.TextTable) -> RichTables:
    """Build a table for the terminal."""
    return RichTables(table)


def millis(value: float) -> str:
    """Format a value in thousandths of the unit."""
    return number(1e3 * value, 1)


def duration(seconds: float) -> str:
    """Format a time [s]; "∞" if infinite, "-" if missing."""
    return "∞" if seconds == math.inf else number(seconds, 2)


def _brief(heading: str) -> str:
    for word, short in _ABBREVIATIONS.items():
        heading = heading.replace(word, short)
    return heading
