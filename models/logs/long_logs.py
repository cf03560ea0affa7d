"""Reduction of long logs to fewer samples per second and to the most informative parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.csv_table import CsvTable
from diffdrive_mpc.models.logs.mapping import FACTORS, Column, Columns
from diffdrive_mpc.models.logs.record import BoolArray, Finding

_PART = 20_000
"""Number of rows of a part; parts are selected or omitted as a whole."""


def reduce_table(
    table: CsvTable, columns: Columns, clock_rows: BoolArray, settings: CheckSettings
) -> tuple[CsvTable, list[Finding]]:
    """Reduce a table to the sample rate that the fastest base needs, and to its most informative parts.

    Parameters
    ----------
    table
        All rows.
    columns
        Mapping of the columns.
    clock_rows
        (n,) True for the rows that are reduced; other rows are messages of slower streams.
    settings
        The thresholds.
    """
    findings = []
    if columns.time is None:
        period = columns.sample_time or settings.decimated_step
    else:
        sample = table.cells(columns.time.column)[clock_rows][:_PART]
        steps = np.diff(sample[np.isfinite(sample)])
        period = FACTORS[columns.time.unit] * float(np.median(steps)) if len(steps) else 0.0
    stride = required_stride(period, settings)
    if stride > 1:
        findings.append(decimation_finding(table.path.name, "row", stride, period))
        table = table.part(~clock_rows | ((np.cumsum(clock_rows) - 1) % stride == 0))
        if not clock_rows.all():
            table.row = np.arange(len(table.row))  # the rest of the rows has no gaps
    if len(table.row) <= settings.max_rows:
        return table, findings
    names = [part.column for _, part in columns.command if isinstance(part, Column)]
    # Convert cells only if some contain words; conversion copies the long columns.
    commands = [table.numbers(name)[0] if table.words else table.cells(name) for name in names]
    selected = most_excited_rows(commands, settings.max_rows)
    findings.append(subset_finding(table.path.name, "rows", len(selected), len(table.row)))
    return table.part(selected), findings


def required_stride(period: float, settings: CheckSettings) -> int:
    """Return the maximum stride that is short enough for all bases; readings are `period` [s] apart."""
    # A step shorter than that of any robot indicates a wrong unit or a burst, which is reported separately.
    is_too_fast = settings.sample_times[0] <= period < settings.min_step
    return round(settings.decimated_step / period) if is_too_fast else 1


def decimation_finding(place: str, noun: str, stride: int, period: float) -> Finding:
    """Return the note that one row or message (`noun`) in `stride` is used; their distance is `period` [s]."""
    message = (
        f"one {noun} in {stride} is used, every {stride * period:.3g} s: no base responds faster, and no controller "
        "runs faster"
    )
    return Finding("decimated", "note", place, message)


def subset_finding(place: str, noun: str, selected: int, count: int) -> Finding:
    """Return the note that `selected` of `count` rows or commands (`noun`) are used."""
    message = (
        f"{selected} of {count} {noun} are used, the parts with the largest changes of commands; to select other "
        "parts, set 'times' or 'where' in the mapping"
    )
    return Finding("subset", "note", place, message)


def most_excited_rows(commands: list[FloatArray], max_rows: int, part: int = _PART) -> NDArray[np.intp]:
    """Select at most `max_rows` rows in order, from the parts of `part` rows with the largest changes of commands (n,).

    A single part is selected even if it is longer.
    """
    count = -(-len(commands[0]) // part)
    score = np.zeros(count)
    for command in commands:
        scale = float(np.nanstd(command))
        if scale > 0:
            # Each part starts with the last row of the previous part; copies of all rows would take half the memory.
            score += [
                np.abs(np.diff(np.nan_to_num(command[max(0, i * part - 1) : (i + 1) * part]))).sum() / scale
                for i in range(count)
            ]
    best = np.sort(np.argsort(-score, kind="stable")[: max(1, max_rows // part)])
    rows = np.concatenate([np.arange(i * part, min((i + 1) * part, len(commands[0]))) for i in best])
    return np.asarray(rows)
