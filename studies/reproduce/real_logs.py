"""Real logs: files, mappings, and the division into rows for fitting and for validation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.logs import Record

_MIN_READINGS = 20


class RealLog(StrictModel):
    """Log of a real robot."""

    robot: str
    file: str = Field(description="path inside the folder of the data")
    mapping: str


class Protocol(StrictModel):
    """Logs, and their division."""

    share: Annotated[float, Field(gt=0, lt=1)] = Field(description="share of the rows for fitting [-]")
    logs: dict[str, RealLog]

    def log(self, name: str) -> RealLog:
        """Return a log by name; raise ConfigError if the name is unknown."""
        if name not in self.logs:
            raise ConfigError(f"unknown log '{name}': give one of {', '.join(self.logs)}")
        return self.logs[name]


@cache
def load_protocol() -> Protocol:
    """Read `real_logs.yaml`; raise ConfigError if it is invalid."""
    return load_checked(Protocol, Path(__file__).with_name("real_logs.yaml"))


def divide(records: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """Divide a log into the first `share` [-] of its rows and the rest; a row is a sample with a new gyro reading.

    Parts with fewer than 20 readings of a sensor are omitted.
    """
    rows = [np.asarray(record.fresh_yaw_rate) for record in records]
    left = round(share * sum(int(row.sum()) for row in rows))
    first: list[Record] = []
    last: list[Record] = []
    for record, row in zip(records, rows, strict=True):
        count = len(row)
        cut = (
            count if left >= row.sum() else int(np.searchsorted(np.cumsum(row), left, side="right")) if left > 0 else 0
        )
        left -= int(row.sum())
        for start, end, into in ((0, cut, first), (cut, count, last)):
            if end > start and _readings(part := record.part(start, end)) >= _MIN_READINGS:
                into.append(part)
    return first, last


def _readings(record: Record) -> int:
    """Return the minimum number of readings over the sensors."""
    return min(int(np.sum(mask)) for mask in (record.fresh_twist, record.fresh_yaw_rate) if mask is not None)
