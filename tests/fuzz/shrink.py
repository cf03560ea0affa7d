"""Make values smaller, the boldest first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any


def fewer(items: list[Any]) -> Iterator[list[Any]]:
    """Lists without a half, a quarter, ... and in the end without one of the items."""
    size = len(items) // 2 or 1
    while items:
        for begin in range(0, len(items), size):
            yield items[:begin] + items[begin + size :]
        if size == 1:
            return
        size = (size + 1) // 2


def without_keys(group: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Groups without some of the keys."""
    for keys in fewer(list(group)):
        yield {key: group[key] for key in keys}


def plainer(value: Any) -> Iterator[Any]:
    """Values of the same shape with plainer numbers and shorter words."""
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, int | float):
        yield from _plainer_number(value)
    elif isinstance(value, str):
        yield from (value[: len(value) // 2], value[len(value) // 2 :]) if len(value) > 1 else ()
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from (value[:place] + [one] + value[place + 1 :] for one in plainer(item))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from ({**value, key: one} for one in plainer(item))


def _plainer_number(value: float) -> Iterator[float]:
    if isinstance(value, int) or not math.isfinite(value):
        return
    for one in (0.0, 1.0, float(f"{value:.1g}"), float(f"{value:.3g}")):
        if one != value and len(repr(one)) < len(repr(value)):
            yield one
