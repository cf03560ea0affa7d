"""Tables in the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
"""Abbreviations of words that would make columns too wide for a terminal of 80 characters."""
_GAP = 2
"""Number of characters between two columns."""
_NOTE_WIDTH = 80
"""Maximum number of characters in a line of a note."""


class Table(plain.TextTable):
    """Table that can be rendered in the terminal."""

    def rich(self) -> RichTables:
        """Build the table for the terminal."""
        return rich_table(self)


@dataclass(frozen=True)
class RichTables:
    """Table that Rich renders within the width of the console.

    Texts and headings wrap. If the columns of numbers are too wide, they are divided into several tables, each of which
    starts with the text columns.
    """

    table: plain.TextTable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the title, the tables one below the other, and the note."""
        if self.table.title:
            yield Text(self.table.title, style="bold")
        for i, widths in enumerate(self._parts(options.max_width)):
            if i > 0:
                yield Text()
            yield self._part(widths)
        if self.table.note:
            # A console without a terminal is wide.
            note = Text(self.table.note, style="table.caption")
            yield Text("\n").join(note.wrap(console, min(options.max_width, _NOTE_WIDTH)))

    def _parts(self, width: int) -> list[dict[int, int]]:
        """Divide the columns into parts of at most `width` characters; return the widths by column of each part."""
        texts = {i: self._min_width(i) for i in range(self.table.text_columns)}
        # Text columns that need more than half the width are narrowed; their words then wrap.
        while texts and sum(texts.values()) + _GAP * len(texts) > max(width // 2, _GAP * len(texts) + len(texts)):
            texts[max(texts, key=texts.__getitem__)] -= 1
        parts = [dict(texts)]
        for i in range(len(texts), len(self.table.columns)):
            required = sum(parts[-1].values()) + self._min_width(i) + _GAP * len(parts[-1])
            if required > width and len(parts[-1]) > len(texts):
                parts.append(dict(texts))
            parts[-1][i] = self._min_width(i)
        for widths in parts:
            remaining = width - sum(widths.values()) - _GAP * (len(widths) - 1)
            for i in widths:
                cells = [_brief(self.table.columns[i]), *(plain_line(row[i]) for row in self.table.rows)]
                extra = min(max(map(cell_len, cells)) - widths[i], remaining)
                widths[i] += max(extra, 0)
                remaining -= max(extra, 0)
        return parts

    def _min_width(self, column: int) -> int:
        """Return the width of the longest word or number of a column, which must not wrap."""
        is_number = column >= self.table.text_columns
        cells = [plain_line(row[column]) for row in self.table.rows]
        words = [word for cell in (_brief(self.table.columns[column]), *cells) for word in cell.split()]
        return max(map(cell_len, [*words, *(cells if is_number else [])]), default=1)

    def _part(self, widths: Mapping[int, int]) -> RichTable:
        # The padding and the invisible line between two columns are the gap.
        table = RichTable(box=box.SIMPLE_HEAD, padding=(0, _GAP - 1, 0, 0), pad_edge=False, show_edge=False)
        for column, width in widths.items():
            justify: Literal["left", "right"] = "right" if column >= self.table.text_columns else "left"
            table.add_column(Text(_brief(self.table.columns[column])), justify=justify, width=width, overflow="fold")
        for row in self.table.rows:
            table.add_row(*(Text(plain_line(row[column])) for column in widths))
        return table


def rich_table(table: plain.TextTable) -> RichTables:
    """Return a table for the terminal."""
    return RichTables(table)


def millis(value: float) -> str:
    """Format a value in thousandths of its unit, such as mm for m."""
    return number(1e3 * value, 1)


def duration(seconds: float) -> str:
    """Format a time [s]; "∞" if infinite, "-" if missing."""
    return "∞" if seconds == math.inf else number(seconds, 2)


def _brief(heading: str) -> str:
    for word, short in _ABBREVIATIONS.items():
        heading = heading.replace(word, short)
    return heading
