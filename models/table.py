"""Tables of text cells, formatted as aligned lines or as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self, TypeVar
from unicodedata import category

T = TypeVar("T")


@dataclass(frozen=True)
class TextTable:
    """Table of text cells with headings; `str` returns text with aligned columns.

    Attributes
    ----------
    title
        Heading above the table; may be empty.
    columns
        Heading of each column, with the unit in brackets.
    rows
        Cells, one for each column in every row.
    text_columns
        Number of left-aligned columns, from the left; the other columns are right-aligned, for numbers.
    note
        One sentence below the table.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text_columns: int = 1
    note: str = ""

    def __post_init__(self) -> None:
        """Raise ValueError if a row does not have a cell for each column."""
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
        """Build a table with one row for each entry.

        Parameters
        ----------
        title, note
            Title of the table and note below it.
        names
            Headings of the columns that hold names.
        columns
            Function that formats the cells of a column, by heading.
        entries
            Names of each row, and argument of the functions.
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
    """Format a cell for `value`; "-" if `value` is not finite."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


# Escapes for untrusted text, such as names of files and names in files.


MAX_LENGTH = 1000
"""Maximum number of characters of a line."""


def plain_line(text: str, max_length: int = MAX_LENGTH) -> str:
    r"""Convert `text` to one line without control characters of terminals or line breaks.

    White space becomes single spaces, characters that cannot be printed become escapes such as ``\x1b``, and text
    beyond `max_length` characters is replaced by "...".
    """
    start = text[: 4 * max_length]  # limits the work for long texts
    line = " ".join(
        "".join(
            character if character.isprintable() or character.isspace() else _escape(character) for character in start
        ).split()
    )
    return line if len(line) <= max_length and len(start) == len(text) else f"{line[: max_length - 3]}..."


def escape(text: str, allowed: str = "") -> str:
    r"""Escape characters of `text` that cannot be printed and are not in `allowed`, as in ``\x1b``."""
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
    return escape(text, "\n\t")


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
