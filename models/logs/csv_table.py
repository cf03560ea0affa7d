"""A CSV file as columns of numbers, with every fault named by its line."""

from __future__ import annotations

import csv
import difflib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import BoolArray, Finding

_SEPARATORS = ",;\t"


@dataclass(frozen=True)
class CsvTable:
    """The cells of a CSV file with a header in its first line.

    Attributes
    ----------
    path
        The file.
    header
        Names of the columns.
    lines
        (n,) line of each row in the file.
    rows
        n rows of cells, as many as the header has names.
    findings
        What was wrong with the file as a table.
    """

    path: Path
    header: list[str]
    lines: FloatArray
    rows: list[list[str]]
    findings: tuple[Finding, ...]

    def numbers(self, name: str) -> tuple[FloatArray, BoolArray]:
        """Numbers (n,) of a column, NaN in empty cells and for what is not finite, and (n,) True for empty cells.

        Raises
        ------
        ConfigError
            If there is no such column, or a cell holds something else than a number.
        """
        cells = self.texts(name)
        empty = np.array([not cell for cell in cells])
        try:
            values = np.array([cell or "nan" for cell in cells], dtype=float)
        except ValueError:
            line, cell = next((int(line), cell) for line, cell in zip(self.lines, cells, strict=True) if _wrong(cell))
            raise ConfigError(
                f"{self.path}, line {line}, column '{name}': '{cell}' is no number; leave the cell empty where a "
                "reading is missing"
            ) from None
        return np.where(np.isfinite(values), values, np.nan), empty

    def texts(self, name: str) -> list[str]:
        """Cells of a column as they stand; raises ConfigError if there is no such column."""
        if name not in self.header:
            near = difflib.get_close_matches(name, self.header, n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(self.header)}"
            raise ConfigError(f"{self.path}: column '{name}' is missing; {hint}")
        index = self.header.index(name)
        return [row[index].strip() for row in self.rows]


def read_table(path: Path) -> CsvTable:
    """Read a CSV file; its separator is a comma, a semicolon or a tab.

    Raises
    ------
    ConfigError
        If the file cannot be read, is empty, names a column twice, or a line has too few or too many cells. Only the
        last line may be cut off: it is left out, with a finding.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            separator = max(_SEPARATORS, key=file.readline().count)
            file.seek(0)
            reader = csv.reader(file, delimiter=separator)
            header = [name.strip() for name in next(reader, [])]
            numbered = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read as CSV ({getattr(error, 'strerror', None) or error})") from error
    twice = next((name for i, name in enumerate(header) if name in header[:i]), None)
    if twice is not None:
        raise ConfigError(f"{path}: column '{twice}' is there twice; rename one")
    findings = []
    if numbered and len(numbered[-1][1]) < len(header):
        findings.append(
            Finding("incomplete line", "note", f"{path.name}, line {numbered[-1][0]}", "cut off; it is left out")
        )
        numbered.pop()
    for line, row in numbered:
        if len(row) != len(header):
            raise ConfigError(f"{path}, line {line}: {len(row)} cells, expected {len(header)} as in the header")
    if not numbered:
        raise ConfigError(f"{path}: no rows; a log has a header line and a row of numbers per sample")
    return CsvTable(
        path, header, np.array([line for line, _ in numbered]), [row for _, row in numbered], tuple(findings)
    )


def _wrong(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return True
    return False
