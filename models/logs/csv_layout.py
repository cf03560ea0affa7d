"""Layout of a CSV file: encoding, separator, column names and first row."""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import open_input

_SEPARATORS = ",;\t"
_MAX_LINE, _MAX_COLUMNS = 1 << 20, 10_000
_COMMA_IN_NUMBER = re.compile(r"(?<=\d),(?=\d)")
_EXCEL = "sep="
"""Prefix of the separator in the optional first line that Excel reads and writes."""


@dataclass(frozen=True)
class CsvLayout:
    """Layout of a CSV file.

    Attributes
    ----------
    names
        Names of the columns, without trailing empty names.
    separator
        Separator of the cells.
    first_row
        Number of the line with the first row, from 1.
    """

    names: list[str]
    separator: str
    first_row: int


def unreadable(path: Path, error: Exception) -> ConfigError:
    """Return the error for a file that cannot be read, or is not a table."""
    remedy = "; is it a log? unpack it if it is compressed, or save it as UTF-8 text"
    problem = getattr(error, "strerror", None) or error
    return ConfigError(f"{path}: cannot be read as CSV ({problem}){'' if isinstance(error, OSError) else remedy}")


def open_csv(path: Path) -> BinaryIO:
    """Open a CSV file as UTF-8, or as UTF-16 with a byte order mark; raise ConfigError if it cannot be opened."""
    if path.suffix in (".yaml", ".yml"):
        raise ConfigError(f"{path}: a YAML file, not a log; give a CSV file, or the folder of a ROS 2 bag")
    try:
        file = open_input(path)
    except OSError as error:
        raise unreadable(path, error) from error
    if file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return cast(BinaryIO, codecs.EncodedFile(file, "utf-8", "utf-16"))
    return file


def read_layout(path: Path, file: BinaryIO) -> CsvLayout:
    """Read the lines before the first row of a file from `open_csv`.

    Raises
    ------
    ConfigError
        If the file is not text, has too many columns, or its first line holds numbers instead of names.
    """
    try:
        first, first_row = rest_of_line(path, file).decode("utf-8-sig"), 2
        separator = first.strip("\r\n")[len(_EXCEL) :] if first.lower().startswith(_EXCEL) else ""
        if separator in tuple(_SEPARATORS):
            first, first_row = rest_of_line(path, file).decode("utf-8"), 3
        else:
            # A comma inside a number is a separator only if the line has no other separator.
            separator = max(_SEPARATORS, key=_COMMA_IN_NUMBER.sub(".", first).count)
        if "\0" in first:
            raise ConfigError(f"{path}: cannot be read as CSV (it contains zero bytes); save it as UTF-8 text")
        if first.count(separator) >= _MAX_COLUMNS:
            raise ConfigError(
                f"{path}: {first.count(separator) + 1:,} columns, the limit is {_MAX_COLUMNS:,}; is it a log?"
            )
        names = [name.strip() for name in next(csv.reader([first], delimiter=separator), [])]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise unreadable(path, error) from error
    while names and not names[-1]:
        names.pop()
    if _are_numbers(names, separator):
        raise ConfigError(
            f"{path}: line {first_row - 1} holds numbers, not the names of the columns; add a line of {len(names)} "
            f"names before it, with '{plain_separator(separator)}' between them"
        )
    return CsvLayout(names, separator, first_row)


def plain_separator(separator: str) -> str:
    """Return a printable name of a separator."""
    return "tab" if separator == "\t" else separator


def _are_numbers(names: list[str], separator: str) -> bool:
    """Return True if the names are readings; consecutive column numbers from 0 or 1 are names."""
    non_empty = [name for name in names if name]
    if not non_empty or any(non_empty == [str(i + start) for i in range(len(non_empty))] for start in (0, 1)):
        return False
    try:
        return bool([float(name if separator == "," else name.replace(",", ".")) for name in non_empty])
    except ValueError:
        return False


def rest_of_line(path: Path, file: BinaryIO) -> bytes:
    """Read the rest of a line; raise ConfigError if it is too long."""
    line = file.readline(_MAX_LINE)
    if len(line) == _MAX_LINE:
        raise ConfigError(f"{path}: a line has more than {_MAX_LINE:,} bytes; is it a log?")
    return line
