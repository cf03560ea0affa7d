"""Scalars that a controller reports at each step, declared in `step_scalars.yaml`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, check, read_yaml


class StepScalar(StrictModel):
    """Declaration of one scalar; `step_scalars.yaml` explains the fields."""

    attribute: str = Field(min_length=1)
    label: str = Field(min_length=1)
    unit: str = Field(min_length=1)
    digits: int = Field(ge=0, le=9)
    help: str = Field(min_length=1)

    @property
    def title(self) -> str:
        """Label with unit."""
        return self.label if self.unit == "-" else f"{self.label} [{self.unit}]"


@cache
def step_scalars() -> Mapping[str, StepScalar]:
    """Return all scalars by column name, in the order of the file."""
    path = Path(__file__).with_suffix(".yaml")
    return {name: check(StepScalar, entry, f"{path}: {name}") for name, entry in read_yaml(path).items()}


def scalar_row(step: object) -> list[float]:
    """Return the scalars of `step` in the order of `step_scalars`; NaN if missing."""
    return [_read(step, get) for get in _getters()]


def scalars_of(step: object) -> dict[str, float]:
    """Return the scalars of `step` that are not missing, by column name."""
    values = zip(step_scalars(), scalar_row(step), strict=True)
    return {name: value for name, value in values if not math.isnan(value)}


@cache
def _getters() -> tuple[attrgetter[Any], ...]:
    return tuple(attrgetter(scalar.attribute) for scalar in step_scalars().values())


def _read(step: object, get: attrgetter[Any]) -> float:
    try:
        value = get(step)
    except AttributeError:
        return math.nan
    return math.nan if value is None else float(value)
