"""Readings that their neighbours contradict: left out of everything, and said.

A filter of Hampel's kind (Journal of the American Statistical Association 1974, 69(346), 383-393): the difference from
the median of five readings around, held against the usual size of such differences and against the range of the signal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Finding, Record
from diffdrive_mpc.models.logs.record import BoolArray, Severity

_NEIGHBOURS = 5
_SIGNALS = {"twist": "fresh_twist", "yaw_rate": "fresh_yaw_rate"}
_SENSORS = {"twist": "encoders", "yaw_rate": "gyro"}


def without_spikes(records: Sequence[Record], name: str) -> tuple[list[Record], list[Finding]]:
    """The records of the log `name` with single wild readings of encoders and gyro no longer marked as readings.

    Returns
    -------
    tuple
        The records, and a finding for each sensor that has any.
    """
    found, cleaned = [], list(records)
    for signal, mask in _SIGNALS.items():
        rows = [i for i, record in enumerate(cleaned) if getattr(record, signal) is not None]
        values = [np.atleast_2d(getattr(cleaned[i], signal).T).T for i in rows]
        fresh = [np.asarray(getattr(cleaned[i], mask)) for i in rows]
        wild = _wild(values, fresh)
        count, total = sum(int(row.sum()) for row in wild), sum(int(row.sum()) for row in fresh)
        if not count:
            continue
        for i, old, out in zip(rows, fresh, wild, strict=True):
            kept: dict[str, Any] = {mask: old & ~out}
            cleaned[i] = replace(cleaned[i], **kept)
        words = (
            f"{count} readings of the {_SENSORS[signal]} ({100 * count / total:.2g} %) are spikes that their "
            "neighbours contradict; they are left out"
        )
        severity: Severity = "warning" if count > identification_settings().spikes.many * total else "note"
        found.append(Finding("spikes", severity, name, words))
    return cleaned, found


def _wild(values: Sequence[FloatArray], fresh: Sequence[BoolArray]) -> list[BoolArray]:
    """For each record (K,) which readings are spikes in any column of its values (K, columns)."""
    settings = identification_settings().spikes
    wild = [np.zeros(len(mask), dtype=bool) for mask in fresh]
    for column in range(values[0].shape[1] if values else 0):
        readings = [value[mask, column] for value, mask in zip(values, fresh, strict=True)]
        away = [np.abs(y - ndimage.median_filter(y, _NEIGHBOURS, mode="nearest")) if len(y) else y for y in readings]
        every, size = np.concatenate(readings), np.concatenate(away)
        if not (size > 0).any():
            continue
        low, high = np.percentile(every, [5, 95])
        usual = float(np.median(size[size > 0]))
        level = max(settings.deviations * 1.4826 * usual, settings.share * float(high - low))
        for out, mask, difference in zip(wild, fresh, away, strict=True):
            out[np.flatnonzero(mask)[difference > level]] = True
    return wild
