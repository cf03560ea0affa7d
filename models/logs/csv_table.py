"""Block-wise reader of columns of a CSV file as numbers; error messages name the line."""

from __future__ import annotations

import csv
import datetime
import difflib
import io
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError, mistakes
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.csv_layout import open_csv, read_layout, rest_of_line, unreadable
from diffdrive_mpc.models.logs.record import BoolArray, Finding
from diffdrive_mpc.models.table import plain_line

# Growing array of numbers for long logs; its peak memory is only slightly more than its final size.


_Scalar = TypeVar("_Scalar", bound=np.generic)
_GROWTH = 8
"""The array grows by its size divided by this number, so that it is rarely copied."""


class GrowingArray(Generic[_Scalar]):
    """Growing array of values of one type.

    Parameters
    ----------
    dtype
        Type of the values.
    zeros
        Number of initial zeros.
    """

    def __init__(self, dtype: type[_Scalar], zeros: int = 0) -> None:
        self._values: NDArray[_Scalar] = np.zeros(zeros, dtype)
        self._count = zeros

    def __len__(self) -> int:
        """Return the number of values."""
        return self._count

    def extend(self, block: NDArray[_Scalar]) -> None:
        """Append a block of values."""
        end = self._count + len(block)
        if end > len(self._values):
            # resize moves memory pages if possible and avoids a second copy.
            self._values.resize(end + end // _GROWTH, refcheck=False)
        self._values[self._count : end] = block
        self._count = end

    def array(self) -> NDArray[_Scalar]:
        """Return all values (n,); the array must not be extended afterwards."""
        self._values.resize(self._count, refcheck=False)
        return self._values


_BLOCK = 1 << 24
"""Number of bytes that are parsed at a time."""
_MIN_RUN = 4
"""Minimum mean length of runs of numbers in a column with NaN, below which NaN counts as an empty cell."""
# Maximum number of characters of an invalid cell in a message.
_MAX_CELL = 60
_MISSING = frozenset(("na", "n/a", "#n/a", "#na", "null", "none", "missing", "-", "--"))
"""Lower-case words that mark a missing reading, like an empty cell. NaN is not a word; it marks a failed reading,
or a missing one if most readings stand between NaN."""
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:")
_WITH_UNIT = re.compile(r"[-+]?[\d.,]*\d([eE][-+]?\d+)?\s*[^\d\s.,:;+-][^\d:]*")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")


@dataclass
class CsvTable:
    """Columns of a CSV file with a header line.

    Attributes
    ----------
    path
        The file.
    header
        Names of all its columns.
    row, lines
        (n,) index of each row in the file, from 0, and its line number.
    values
        (n,) cells of each selected column; numbers at or below `_FIRST_WORD` represent words.
    empty
        (n,) True for empty cells, for columns with empty cells.
    words
        Number that represents each word in a cell.
    findings
        Findings from parsing the file.
    """

    path: Path
    header: list[str]
    row: NDArray[np.int64]
    lines: NDArray[np.int64]
    values: dict[str, FloatArray]
    empty: dict[str, BoolArray]
    words: dict[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def numbers(self, name: str) -> tuple[FloatArray, BoolArray]:
        """Return the numbers (n,) of a column, NaN for empty or invalid cells, and (n,) True for empty cells.

        Raises
        ------
        ConfigError
            If there is no such column, or a cell is not a number.
        """
        values = self.cells(name)
        empty = self.empty.get(name, np.zeros(len(values), dtype=bool))
        is_invalid = np.isin(values, list(self.words.values())) if self.words else np.zeros(len(values), dtype=bool)
        if is_invalid.any():
            is_missing = np.isin(values, [number for word, number in self.words.items() if word.lower() in _MISSING])
            values, empty = np.where(is_missing, np.nan, values), empty | is_missing
            is_invalid &= ~is_missing
        if is_invalid.any():
            index = int(np.argmax(is_invalid))
            cell = next(word for word, number in self.words.items() if number == values[index])
            remedy = "write a number such as 1000.5, or leave the cell empty if a reading is missing"
            if _DECIMAL_COMMA.fullmatch(cell):
                remedy = "write decimals with a point, or with a comma throughout and semicolons between the cells"
            elif len(self.values) > 1 and all(cells[index] <= _FIRST_WORD for cells in self.values.values()):
                remedy = "no cell of this line is one: delete the line, such as a second header or a row of units"
            elif ":" in cell:
                remedy = "give seconds, or dates with times such as 2026-01-31T12:30:00"
            elif _WITH_UNIT.fullmatch(cell):
                remedy = "remove the units from the cells, and state the `unit` of the column in the mapping"
            raise ConfigError(
                f"{self.path}, line {self.lines[index]}, column '{name}': '{plain_line(cell, _MAX_CELL)}' is not a "
                f"number; {remedy}"
            )
        return np.where(np.isfinite(values), values, np.nan), empty

    def cells(self, name: str) -> FloatArray:
        """Return the cells (n,) of a column with words as numbers; raise ConfigError if the column is missing."""
        require_columns(self.path, self.header, [name])
        return self.values[name]

    def require_numbers(self) -> None:
        """Raise ConfigError if each column contains a word, for instance in a row of units."""
        if self.values and all((cells <= _FIRST_WORD).any() for cells in self.values.values()):
            self.numbers(self.header[0])

    def cell(self, text: str | float) -> float:
        """Return the value by which `cells` represents a number or word; NaN if no cell contains the word."""
        try:
            return _parse_number(str(text))
        except ValueError:
            return self.words.get(str(text).strip(), float("nan"))

    def part(self, rows: NDArray[np.intp] | BoolArray) -> CsvTable:
        """Return a table with the selected rows."""
        values = {name: cells[rows] for name, cells in self.values.items()}
        empty = {name: cells[rows] for name, cells in self.empty.items()}
        return CsvTable(
            self.path, self.header, self.row[rows], self.lines[rows], values, empty, self.words, self.findings
        )


_FIRST_WORD = -1e300
"""Number that represents the first word; further words have lower numbers."""


def read_header(path: Path) -> list[str]:
    """Read the names of the columns; raise ConfigError as `read_table` does."""
    with open_csv(path) as file:
        return read_layout(path, file).names


def require_columns(path: Path, header: Sequence[str], names: Collection[str]) -> None:
    """Raise ConfigError that lists all `names` missing from the header, each with a similar name if there is one."""
    sentences = []
    for name in sorted(set(names) - set(header)):
        near = difflib.get_close_matches(name, header, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(header)}"
        sentences.append(f"column '{name}' is missing; {hint}")
    if sentences:
        raise ConfigError(mistakes(str(path), sentences))


def read_table(path: Path, names: Collection[str]) -> CsvTable:
    """Read columns of a CSV file with comma, semicolon or tab as separator.

    Files with semicolons or tabs may have decimal commas. Peak memory is one block of text, eight bytes for each cell
    of the columns `names`, and temporary copies of two columns.

    Raises
    ------
    ConfigError
        If the file cannot be read or is empty, a column name occurs twice, or a line has too few or too many cells. A
        truncated last line is not an error; it is left out with a finding.
    """
    lines: GrowingArray[np.int64] = GrowingArray(np.int64)
    words: dict[str, float] = {}
    findings: list[Finding] = []
    with open_csv(path) as file:
        layout = read_layout(path, file)
        header, separator = layout.names, layout.separator
        duplicate, count = Counter(filter(None, header)).most_common(1)[0] if any(header) else ("", 0)
        if count > 1:
            raise ConfigError(f"{path}: column '{duplicate}' occurs twice; rename one")
        selected = list(dict.fromkeys(name for name in header if name in names))
        values: dict[str, GrowingArray[np.float64]] = {name: GrowingArray(np.float64) for name in selected}
        missing: dict[str, GrowingArray[np.bool_]] = {}
        line = layout.first_row
        try:
            for text, last in _blocks(path, file):
                parsed = _parse_with_numpy(text, separator, header, selected)
                if parsed is None:
                    parsed = _parse_cells(
                        path, text, separator, header, selected, line, words, findings if last else None
                    )
                parsed_cells, empty, numbers = parsed
                for name in selected:
                    values[name].extend(parsed_cells[name])
                    if name in empty or name in missing:
                        missing.setdefault(name, GrowingArray(np.bool_, len(lines))).extend(
                            empty.get(name, np.zeros(len(numbers), dtype=bool))
                        )
                lines.extend(line + numbers)
                line += text.count("\n")
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise unreadable(path, error) from error
    if not len(lines):
        raise ConfigError(f"{path}: the file has no rows; a log has a header line and a row of numbers per sample")
    cells = {name: column.array() for name, column in values.items()}
    empty_cells = {name: column.array() for name, column in missing.items()}
    for name, column in cells.items():
        is_number = ~np.isnan(column)
        runs = int(np.count_nonzero(np.diff(is_number, prepend=False)[is_number]))
        # NaN between short runs of numbers marks rows without a new reading, not faults.
        if np.count_nonzero(is_number) < min(_MIN_RUN * runs, len(column)):
            empty_cells[name] = ~is_number
    return CsvTable(path, header, np.arange(len(lines)), lines.array(), cells, empty_cells, words, tuple(findings))


def _blocks(path: Path, file: BinaryIO) -> Iterator[tuple[str, bool]]:
    """Yield blocks of whole lines, and True for the last block."""
    text = file.read(_BLOCK) + rest_of_line(path, file)
    while text:
        following = file.read(_BLOCK)
        following += rest_of_line(path, file) if following else b""
        yield text.decode("utf-8").replace("\r\n", "\n"), not following
        text = following


_Parsed = tuple[dict[str, FloatArray], dict[str, BoolArray], NDArray[np.int64]]


def _parse_with_numpy(text: str, separator: str, header: list[str], selected: list[str]) -> _Parsed | None:
    """Parse a block of numbers and empty cells with NumPy; return None if it has quotes, words or short lines."""
    count = text.count("\n") + (not text.endswith("\n"))
    if '"' in text or "\n\n" in text or not selected or not _is_rectangular(text, separator, len(header), count):
        return None
    # Decimal commas; if the block also has points, `_parse_cells` distinguishes the columns.
    if separator != "," and "," in text:
        if "." in text:
            return None
        text = text.replace(",", ".")
    filled = _fill_empty_cells(text, separator)
    # After filling, NaN must represent empty cells only.
    if filled is not text and "nan" in text.lower():
        return None
    columns = [header.index(name) for name in selected]
    try:
        table = np.loadtxt(io.StringIO(filled), delimiter=separator, usecols=columns, comments=None, ndmin=2)
    except ValueError:
        return None
    if len(table) != count:
        return None
    empty = {}
    if filled is not text:
        empty = {name: np.isnan(table[:, i]) for i, name in enumerate(selected) if np.isnan(table[:, i]).any()}
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(selected)}, empty, np.arange(count)


def _is_rectangular(text: str, separator: str, columns: int, count: int) -> bool:
    """Return True if each of `count` lines has one cell per column, plus an equal number of trailing empty cells."""
    tail, remainder = divmod(text.count(separator) - count * (columns - 1), count)
    if tail <= 0 or remainder:
        return tail == remainder == 0
    end = tail * separator
    return text.count(f"{end}\n") + text.endswith(end) == count


def _fill_empty_cells(text: str, separator: str) -> str:
    """Replace empty cells of the text by "nan"."""
    duplicate, first, last = 2 * separator, f"\n{separator}", f"{separator}\n"
    if not (duplicate in text or first in text or last in text or text[0] == separator or text[-1] == separator):
        return text
    # Replace twice, because adjacent empty cells share a separator.
    for _ in range(2):
        text = text.replace(duplicate, f"{separator}nan{separator}")
    text = text.replace(last, f"{separator}nan\n").replace(first, f"\nnan{separator}")
    text = f"nan{text}" if text[0] == separator else text
    return f"{text}nan" if text[-1] == separator else text


def _parse_cells(
    path: Path,
    text: str,
    separator: str,
    header: list[str],
    selected: list[str],
    line: int,
    words: dict[str, float],
    findings: list[Finding] | None,
) -> _Parsed:
    """Parse a block cell by cell; it starts at `line`. `findings` is set for the last block, which may be truncated."""
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    numbered_rows = [(reader.line_num - 1, row) for row in reader if row]
    if findings is not None and numbered_rows and len(numbered_rows[-1][1]) < len(header):
        place = f"{path.name}, line {line + numbered_rows[-1][0]}"
        findings.append(Finding("incomplete line", "note", place, "the line is truncated and left out"))
        numbered_rows.pop()
    for offset, row in numbered_rows:
        if len(row) < len(header) or any(row[len(header) :]):
            hint = "; complete the row, or quote cells that contain the separator"
            if "".join(header).startswith("#"):
                hint = "; the first line is not the header: delete the lines before the header"
            elif separator == "," and all(cell.strip().lstrip("+-").isdigit() for cell in row):
                hint = "; if decimals have a comma, put semicolons between the cells"
            raise ConfigError(
                f"{path}, line {line + offset}: {len(row)} cells, expected {len(header)} as in the header{hint}"
            )
    values, missing = {}, {}
    for name in selected:
        index = header.index(name)
        cells = [row[index].strip() for _, row in numbered_rows]
        values[name] = to_numbers(cells, words, decimal_comma=separator != ",")
        empty = np.array([not cell for cell in cells], dtype=bool)
        if empty.any():
            missing[name] = empty
    return values, missing, np.array([offset for offset, _ in numbered_rows], dtype=np.int64)


def to_numbers(cells: list[str], words: dict[str, float], *, decimal_comma: bool = False) -> FloatArray:
    """Convert cells (n,) to numbers, with NaN for empty cells; add other texts to `words`.

    With `decimal_comma`, commas are decimal separators unless a cell contains a point.
    """
    texts = cells
    if decimal_comma and not any("." in cell for cell in cells):
        texts = [cell.replace(",", ".") for cell in cells]
    try:
        return np.array([text or "nan" for text in texts], dtype=float)
    except ValueError:
        return np.array([_number(text, cell, words) for text, cell in zip(texts, cells, strict=True)])


def _parse_number(text: str) -> float:
    """Parse a number, or a date and time in ISO 8601 (UTC by default) as seconds since 1970."""
    try:
        return float(text)
    except ValueError:
        if not _DATE.match(text):
            raise
        time = datetime.datetime.fromisoformat(text)
        return (time if time.tzinfo else time.replace(tzinfo=datetime.UTC)).timestamp()


def _number(text: str, cell: str, words: dict[str, float]) -> float:
    try:
        return _parse_number(text or "nan")
    except ValueError:
        if len(words) >= file_limits().csv_words and cell not in words:
            raise ConfigError(
                f"a cell holds '{plain_line(cell, _MAX_CELL)}', after {len(words):,} other words; name columns of "
                "numbers"
            ) from None
        # Doubles of this magnitude are widely spaced; a step of 1e294 distinguishes the words.
        return words.setdefault(cell, _FIRST_WORD * (1 + len(words) / 1e6))
