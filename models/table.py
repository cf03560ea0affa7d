"""A table as plain text cells, printed as aligned lines or written as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self, TypeVar
from unicodedata import category

T = TypeVar("T")


@dataclass(frozen=True)
class TextTable:
    """Cells with their headings. `str` of it is text with aligned columns.

    Attributes
    ----------
    title
        Heading above the table; empty for none.
    columns
        Heading of each column, with the unit in brackets.
    rows
        Cells, as many in each row as there are columns.
    text_columns
        Number of columns from the left that hold names; the others contain right-aligned numbers.
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
    def build(
        cls,
        title: str,
        names: tuple[str, ...],
        columns: Mapping[str, Callable[[T], str]],
        entries: Iterable[tuple[tuple[str, ...], T]],
        note: str = "",
    ) -> Self:
        """Build a table of `entries`, each with the names on its left and the source of its cells.

        Parameters
        ----------
        title, note
            Title of the table and note below it.
        names
            Headings of the columns that hold names.
        columns
            By the heading of a column, the function for its cells.
        entries
            One for each row.
        """
        rows = tuple((*left, *(cell(right) for cell in columns.values())) for left, right in entries)
        return cls(title, (*names, *columns), rows, len(names), note)

    def __str__(self) -> str:
        """Format title, headings, rows and note."""
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        lines = ["  ".join(self._aligned(cells, widths)).rstrip() for cells in (self.columns, *self.rows)]
        return plain_text("\n".join(line for line in (self.title, *lines, self.note) if line))

    def markdown(self) -> str:
        """Format the table as a Markdown section."""
        rule = ["---" if i < self.text_columns else "---:" for i in range(len(self.columns))]
        lines = [_markdown_row(cells) for cells in (self.columns, rule, *self.rows)]
        note = ["", self.note] if self.note else []
        return "\n".join([f"## {self.title}", "", *lines, *note, ""])

    def _aligned(self, cells: Sequence[str], widths: Sequence[int]) -> list[str]:
        pairs = enumerate(zip(cells, widths, strict=True))
        return [cell.ljust(width) if i < self.text_columns else cell.rjust(width) for i, (cell, width) in pairs]


def number(value: float, digits: int = 4) -> str:
    """Format a cell for `value`; "-" if it is missing."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


# Escapes for untrusted text, such as names in files and of files.


LONGEST = 1000
"""Characters of a line at most."""


def plain_line(text: str, longest: int = LONGEST) -> str:
    r"""Escape `text` to one line that steers neither a terminal nor a parser of lines.

    White space becomes single blanks, other characters that cannot be printed become escapes such as ``\x1b``, and text
    beyond `longest` characters is cut with "...".
    """
    cut = text[: 4 * longest]  # the rest is not shown, and need not be examined
    line = " ".join(
        "".join(
            character if character.isprintable() or character.isspace() else _escape(character) for character in cut
        ).split()
    )
    return line if len(line) <= longest and len(cut) == len(text) else f"{line[: longest - 3]}..."


def escaped(text: str, allowed: str = "") -> str:
    r"""Return `text` with escapes such as ``\x1b`` for characters that cannot be printed and are not in `allowed`."""
    if text.isprintable():
        return text
    return "".join(
        character
        if character.isprintable() or character in allowed or category(character) == "Zs"
        else _escape(character)
        for character in text
    )


def plain_text(text: str) -> str:
    r"""Escape characters of `text` that cannot be printed, except for line breaks and tabs, as in ``\x1b``."""
    return escaped(text, "\n\t")


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
