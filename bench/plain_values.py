"""Conversion to values that JSON supports."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel


def plain(value: object, digits: int | None = None) -> Any:  # noqa: ANN401 - any value of JSON
    """Convert dataclasses, Pydantic models, mappings, sequences and arrays to JSON values; NaN and infinity give None.

    Parameters
    ----------
    value
        Value to convert.
    digits
        Number of significant digits of numbers other than integers; None for all digits.
    """
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(entry, digits) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(entry, digits) for entry in value]
    if isinstance(value, (float, np.floating)):
        number = float(value) if digits is None else float(f"{value:.{digits}g}")
        return number if math.isfinite(number) else None
    return value
