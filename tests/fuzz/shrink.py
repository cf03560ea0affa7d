"""Reduce values, in the largest steps first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any


def fewer(items: list[Any]) -> Iterator[list[Any]]:
    """Yield lists without a half, a quarter, ... and without a single item."""
    size = len(items) // 2 or 1
    while items:
        for start in range(0, len(items), size):
            yield items[:start] + items[start + size :]
        if size == 1:
            return
        size = (size + 1) // 2


def without_keys(group: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield groups without some of the keys."""
    for keys in fewer(list(group)):
        yield {key: group[key] for key in keys}


def plainer(value: Any) -> Iterator[Any]:
    """Yield values of the same shape with plainer numbers and shorter words."""
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int | float):
        yield from _plainer_number(value)
    elif isinstance(value, str):
        yield from (value[: len(value) // 2], value[len(value) // 2 :]) if len(value) > 1 else ()
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from (value[:place] + [smaller] + value[place + 1 :] for smaller in plainer(item))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from ({**value, key: smaller} for smaller in plainer(item))


def _plainer_number(value: float) -> Iterator[float]:
    if isinstance(value, int) or not math.isfinite(value):
        return
    for number in (0.0, 1.0, float(f"{value:.1g}"), float(f"{value:.3g}")):
        if number != value and len(repr(number)) < len(repr(value)):
            yield number
