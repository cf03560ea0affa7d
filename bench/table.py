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
"""Words that would make columns too wide for a terminal of 80 characters."""
_GAP = 2
"""Characters between two columns."""


class Table(plain.TextTable):
    """A table that the terminal draws."""

    def rich(self) -> RichTables:
        """The table for the terminal."""
        return rich_table(self)


@dataclass(frozen=True)
class RichTables:
    """A table that Rich draws as wide as the console allows.

    Texts and headings wrap. Where the numbers do not fit side by side, they continue in further tables, which repeat
    the columns of names.
    """

    table: plain.TextTable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the parts, one below the other."""
        parts = _split(self.table, options.max_width)
        for i, (columns, widths) in enumerate(parts):
            if i > 0:
                yield Text()
            yield self._part(columns, widths, is_first=i == 0, is_last=i == len(parts) - 1)

    def _part(self, columns: Sequence[int], widths: Sequence[int], *, is_first: bool, is_last: bool) -> RichTable:
        table = self.table
        drawn = RichTable(
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
        for column, width in zip(columns, widths, strict=True):
            justify: Literal["left", "right"] = "right" if column >= table.text_columns else "left"
            drawn.add_column(Text(_brief(table.columns[column])), justify=justify, width=width, overflow="fold")
        for row in table.rows:
            drawn.add_row(*(Text(plain_line(row[column])) for column in columns))
        return drawn


def rich_table(table: plain.TextTable) -> RichTables:
    """A table for the terminal."""
    return RichTables(table)


def _split(table: plain.TextTable, width: int) -> list[tuple[list[int], list[int]]]:
    """The columns of each part of a table of at most `width` characters, with their widths."""
    cells = [
        [_brief(heading), *map(plain_line, column)] for heading, *column in zip(table.columns, *table.rows, strict=True)
    ]
    wide = [max(map(cell_len, column)) for column in cells]
    # Texts and headings break between words, numbers not at all.
    least = [max(cell_len(word) for cell in column for word in cell.split() or [""]) for column in cells]
    columns = list(range(len(cells)))
    names, numbers = columns[: table.text_columns], columns[table.text_columns :]
    for i in numbers:
        least[i] = max([least[i], *map(cell_len, cells[i][1:])])
    # Where there is no room for the names and one number, names break within words, too; those on the left last.
    room = width - max((least[i] + _GAP for i in numbers), default=0)
    unbroken = [min(least[i], room // 3) if i == 0 else 1 for i in names]
    least[: len(names)] = _fit(least[: len(names)], unbroken, room)
    parts = [names]
    for i in numbers:
        if len(parts[-1]) > len(names) and _total([least[j] for j in (*parts[-1], i)]) > width:
            parts.append(names)
        parts[-1] = [*parts[-1], i]
    return [(part, _fit([wide[i] for i in part], [least[i] for i in part], width)) for part in parts]


def _fit(widths: Sequence[int], least: Sequence[int], total: int) -> list[int]:
    """Make the widest columns narrower, none below its `least`, until all of them fit into `total` characters."""
    fitted = list(widths)
    while _total(fitted) > total:
        shrinkable = [i for i, width in enumerate(fitted) if width > least[i]]
        if not shrinkable:
            break
        fitted[max(shrinkable, key=lambda i: fitted[i])] -= 1
    return fitted


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * (len(widths) - 1)


def millis(value: float) -> str:
    """A cell in thousandths of its unit."""
    return number(1e3 * value, 1)


def duration(seconds: float) -> str:
    """A cell for a time [s]; "∞" for never, "-" where there is none."""
    return "∞" if seconds == math.inf else number(seconds, 2)


def _brief(heading: str) -> str:
    for word, short in _ABBREVIATIONS.items():
        heading = heading.replace(word, short)
    return heading
