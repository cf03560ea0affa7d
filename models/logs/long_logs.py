"""Reduction of long logs: fewer samples per second, and the most informative parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.csv_table import CsvTable
from diffdrive_mpc.models.logs.mapping import FACTORS, Column, Columns
from diffdrive_mpc.models.logs.record import Finding

_PART = 20_000
"""Rows that are taken or left together."""


def chosen_rows(table: CsvTable, columns: Columns, settings: CheckSettings) -> tuple[CsvTable, list[Finding]]:
    """Remove rows that no base is fast enough to need, and the least informative parts, from the table.

    Parameters
    ----------
    table
        All rows.
    columns
        Mapping of the columns.
    settings
        The thresholds.
    """
    findings = []
    if columns.time is None:
        period = columns.sample_time or settings.needed_step
    else:
        sample = table.cells(columns.time.column)[:_PART]
        steps = np.diff(sample[np.isfinite(sample)])
        period = FACTORS[columns.time.unit] * float(np.median(steps)) if len(steps) else 0.0
    stride = needed_stride(period, settings)
    if stride > 1:
        findings.append(decimated(table.path.name, "row", stride, period))
        table = table.part(np.arange(0, len(table.row), stride))
    if len(table.row) <= settings.most_rows:
        return table, findings
    names = [part.column for _, part in columns.command if isinstance(part, Column)]
    # Words for a missing reading are huge among the cells; without any the cells are not copied, they are many.
    commands = [table.numbers(name)[0] if table.words else table.cells(name) for name in names]
    taken = most_driven(commands, settings.most_rows)
    findings.append(subset(table.path.name, "rows", len(taken), len(table.row)))
    return table.part(taken), findings


def needed_stride(period: float, settings: CheckSettings) -> int:
    """Compute the largest stride of readings `period` [s] apart that no base is too fast for."""
    # A clock faster than the sample time of any robot is a wrong unit or a burst, and reported as such.
    quick = settings.sample_times[0] <= period < settings.shortest_step
    return round(settings.needed_step / period) if quick else 1


def decimated(place: str, noun: str, stride: int, period: float) -> Finding:
    """Return the note that one `noun` in `stride`, which are `period` [s] apart, is used."""
    words = (
        f"one {noun} in {stride} is used, {stride * period:.3g} s apart: a base does not move in less, and no "
        "controller is run faster"
    )
    return Finding("decimated", "note", place, words)


def subset(place: str, noun: str, taken: int, count: int) -> Finding:
    """Return the note that `taken` of `count` rows or commands are used."""
    words = (
        f"{taken} of {count} {noun} are used, the parts in which the command changes most; cut the log by "
        "'times' or 'where' in the mapping to choose others"
    )
    return Finding("subset", "note", place, words)


def most_driven(commands: list[FloatArray], most: int, part: int = _PART) -> NDArray[np.intp]:
    """Select at most `most` rows, in order, of the parts of `part` rows in which the commands (n,) change most."""
    count = -(-len(commands[0]) // part)
    score = np.zeros(count)
    for command in commands:
        scale = float(np.nanstd(command))
        if scale > 0:
            # Part by part, each from the last row of the one before: copies of all rows would be half of the memory.
            score += [
                np.abs(np.diff(np.nan_to_num(command[max(0, i * part - 1) : (i + 1) * part]))).sum() / scale
                for i in range(count)
            ]
    best = np.sort(np.argsort(-score, kind="stable")[: max(1, most // part)])
    rows = np.concatenate([np.arange(i * part, min((i + 1) * part, len(commands[0]))) for i in best])
    return np.asarray(rows)
