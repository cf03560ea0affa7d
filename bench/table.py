"""A table as plain text cells, shown in the terminal or written as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from rich import box
from rich.table import Table as RichTable
from rich.text import Text

T = TypeVar("T")

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


@dataclass(frozen=True)
class Table:
    """Cells with their headings.

    Attributes
    ----------
    title
        Heading above the table.
    columns
        Heading of each column, with the unit in brackets.
    rows
        Cells, as many in each row as there are columns.
    text_columns
        How many columns from the left hold names; the others hold numbers and are aligned to the right.
    note
        One sentence below the table.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text_columns: int = 1
    note: str = ""

    def __post_init__(self) -> None:
        """Check that every row has a cell for each column; raises ValueError."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.title}': {len(row)} cells for {len(self.columns)} columns")

    @classmethod
    def of(
        cls,
        title: str,
        names: tuple[str, ...],
        columns: Mapping[str, Callable[[T], str]],
        entries: Iterable[tuple[tuple[str, ...], T]],
        note: str = "",
    ) -> Table:
        """A table of `entries`, each the names on its left and what its cells are made of.

        Parameters
        ----------
        title, note
            Of the table.
        names
            Headings of the columns that hold names.
        columns
            By the heading of a column, what gives its cells.
        entries
            One for each row.
        """
        rows = tuple((*left, *(cell(right) for cell in columns.values())) for left, right in entries)
        return cls(title, (*names, *columns), rows, len(names), note)

    def markdown(self) -> str:
        """The table as a Markdown section."""
        rule = ["---" if i < self.text_columns else "---:" for i in range(len(self.columns))]
        lines = [_markdown_row(cells) for cells in (self.columns, rule, *self.rows)]
        note = ["", self.note] if self.note else []
        return "\n".join([f"## {self.title}", "", *lines, *note, ""])

    def rich(self) -> RichTable:
        """The table for the terminal."""
        table = RichTable(
            title=Text(self.title, style="bold"),
            caption=Text(self.note) if self.note else None,
            title_justify="left",
            caption_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1),
            collapse_padding=True,
            pad_edge=False,
            show_edge=False,
        )
        for i, heading in enumerate(self.columns):
            number = i >= self.text_columns
            # Headings and sentences may break in a narrow terminal, numbers and names must not.
            longest = max((len(row[i]) for row in self.rows), default=0)
            least = longest if number or longest <= 10 else None
            justify: Literal["left", "right"] = "right" if number else "left"
            table.add_column(Text(_brief(heading)), justify=justify, min_width=least, overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell) for cell in row))
        return table


def number(value: float, digits: int = 4) -> str:
    """A cell for `value`; "-" where it could not be computed."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def duration(seconds: float) -> str:
    """A cell for a time [s]; "∞" for never, "-" where there is none."""
    return "∞" if seconds == math.inf else number(seconds, 2)


def _brief(heading: str) -> str:
    for word, short in _ABBREVIATIONS.items():
        heading = heading.replace(word, short)
    return heading


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
