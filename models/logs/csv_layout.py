"""Layout of a CSV file: encoding, separator, column names and first row."""

from __future__ import annotations

import codecs
import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import open_input

_SEPARATORS = ",;\t"
_LONGEST_LINE, _MOST_COLUMNS = 1 << 20, 10_000
_COMMA_IN_NUMBER = re.compile(r"(?<=\d),(?=\d)")
_EXCEL = "sep="
"""Before a separator, alone in the first line: Excel's note to itself."""


@dataclass(frozen=True)
class CsvLayout:
    """Layout of a CSV file by its first lines.

    Attributes
    ----------
    names
        Names of the columns, without those at the end that have none.
    separator
        Between two cells.
    first_row
        Line on which its rows begin, from 1.
    """

    names: list[str]
    separator: str
    first_row: int


class _Recoded(io.RawIOBase):
    """A file in UTF-16, read as UTF-8."""

    def __init__(self, file: BinaryIO) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-16", newline="")

    def readable(self) -> bool:
        """Return True: the file is readable."""
        return True

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]
        """Fill in the fitting fields; of UTF-8 no character takes more than four bytes."""
        block = self._text.read(len(buffer) // 4).encode()
        buffer[: len(block)] = block
        return len(block)

    def close(self) -> None:
        """Close the file, too."""
        self._text.close()
        super().close()


def open_csv(path: Path) -> io.BufferedReader:
    """Open a CSV file as UTF-8, or by its byte order mark; raise ConfigError if it cannot be opened."""
    try:
        file = open_input(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read as CSV ({error.strerror or error})") from error
    if file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return io.BufferedReader(_Recoded(file))
    return file


def read_layout(path: Path, file: BinaryIO) -> CsvLayout:
    """Read up to the first row of a file from `open_csv`.

    Raises
    ------
    ConfigError
        If it is no text, has too many columns, or its first line holds numbers in place of names.
    """
    try:
        first, first_row = rest_of_line(path, file).decode("utf-8-sig"), 2
        separator = first.strip("\r\n")[len(_EXCEL) :] if first.lower().startswith(_EXCEL) else ""
        if separator in tuple(_SEPARATORS):
            first, first_row = rest_of_line(path, file).decode("utf-8"), 3
        else:
            # A comma inside a number separates nothing, unless there is no other separator.
            separator = max(_SEPARATORS, key=_COMMA_IN_NUMBER.sub(".", first).count)
        if "\0" in first:
            raise ConfigError(f"{path}: cannot be read as CSV (it holds bytes that are no text); save it as UTF-8 text")
        if first.count(separator) >= _MOST_COLUMNS:
            raise ConfigError(
                f"{path}: {first.count(separator) + 1:,} columns, at most {_MOST_COLUMNS:,}; is it a log?"
            )
        names = [name.strip() for name in next(csv.reader([first], delimiter=separator), [])]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        remedy = "" if isinstance(error, OSError) else "; save it as UTF-8 text"
        problem = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot be read as CSV ({problem}){remedy}") from error
    while names and not names[-1]:
        names.pop()
    if _are_numbers(names, separator):
        raise ConfigError(
            f"{path}: line {first_row - 1} holds numbers, not the names of the columns; add a line of {len(names)} "
            f"names before it, with '{plain_separator(separator)}' between them"
        )
    return CsvLayout(names, separator, first_row)


def plain_separator(separator: str) -> str:
    """Convert a separator to printable text."""
    return "tab" if separator == "\t" else separator


def _are_numbers(names: list[str], separator: str) -> bool:
    """Return True if the names are readings; names that count the columns from 0 or 1 are names."""
    filled = [name for name in names if name]
    if not filled or any(filled == [str(i + start) for i in range(len(filled))] for start in (0, 1)):
        return False
    try:
        return bool([float(name if separator == "," else name.replace(",", ".")) for name in filled])
    except ValueError:
        return False


def rest_of_line(path: Path, file: BinaryIO) -> bytes:
    """Read the rest of a line; raise ConfigError if it does not end."""
    line = file.readline(_LONGEST_LINE)
    if len(line) == _LONGEST_LINE:
        raise ConfigError(f"{path}: a line of more than {_LONGEST_LINE:,} bytes; is it a log?")
    return line
