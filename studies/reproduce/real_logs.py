"""Logs of real robots: files, mappings, and division into rows for fitting and for validation."""

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
    file: str = Field(description="path relative to the folder of the data")
    mapping: str


class Protocol(StrictModel):
    """Logs, and the share of their rows for fitting; all other rows are for validation."""

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
    """Divide a log into the first `share` [-] of its rows and all other rows; rows are samples with a new gyro reading.

    Return the records of both parts, without records that have fewer than `_MIN_READINGS` readings of a sensor.
    """
    row_masks = [np.asarray(record.fresh_yaw_rate) for record in records]
    remaining = round(share * sum(int(mask.sum()) for mask in row_masks))
    training: list[Record] = []
    validation: list[Record] = []
    for record, mask in zip(records, row_masks, strict=True):
        count = len(mask)
        split = int(np.searchsorted(np.cumsum(mask), remaining, side="right")) if remaining > 0 else 0
        cut = count if remaining >= mask.sum() else split
        remaining -= int(mask.sum())
        for start, end, part_list in ((0, cut, training), (cut, count, validation)):
            if end > start and _readings(part := record.part(start, end)) >= _MIN_READINGS:
                part_list.append(part)
    return training, validation


def _readings(record: Record) -> int:
    """Return the minimum number of readings over the sensors of a record."""
    return min(int(np.sum(mask)) for mask in (record.fresh_twist, record.fresh_yaw_rate) if mask is not None)
