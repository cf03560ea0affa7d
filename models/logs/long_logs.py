"""What of a log too long to be used whole is read on with: fewer samples a second, and the parts that teach most."""

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
    """The table without rows that no base is quick enough to need, and without parts that say least.

    Parameters
    ----------
    table
        All rows.
    columns
        What they are.
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
    stride = round(settings.needed_step / period) if 0 < period < settings.shortest_step else 1
    # A clock of less than a sample time of any robot is a wrong unit or a burst, and told as such.
    if stride > 1 and period >= settings.sample_times[0]:
        words = (
            f"one row in {stride} is used, {stride * period:.3g} s apart: a base does not move in less, and "
            "no controller "
            "is run faster"
        )
        findings.append(Finding("decimated", "note", table.path.name, words))
        table = table.part(np.arange(0, len(table.row), stride))
    if len(table.row) <= settings.most_rows:
        return table, findings
    names = [part.column for _, part in columns.command if isinstance(part, Column)]
    taken = most_driven([table.cells(name) for name in names], settings.most_rows)
    words = (
        f"{len(taken)} of {len(table.row)} rows are used, the parts in which the command changes most; cut the log by "
        "'times' or 'where' in the mapping to choose others"
    )
    findings.append(Finding("subset", "note", table.path.name, words))
    return table.part(taken), findings


def most_driven(commands: list[FloatArray], most: int, part: int = _PART) -> NDArray[np.intp]:
    """At most `most` rows, in order, of the parts of `part` rows in which the commands (n,) change most."""
    count = -(-len(commands[0]) // part)
    score = np.zeros(count)
    for command in commands:
        change = np.abs(np.diff(np.nan_to_num(command), prepend=np.nan_to_num(command[:1])))
        scale = float(np.nanstd(command))
        if scale > 0:
            score += np.add.reduceat(change, np.arange(0, len(command), part)) / scale
    best = np.sort(np.argsort(-score, kind="stable")[: max(1, most // part)])
    rows = np.concatenate([np.arange(i * part, min((i + 1) * part, len(commands[0]))) for i in best])
    return np.asarray(rows)
