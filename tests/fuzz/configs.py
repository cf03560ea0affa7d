"""Random configurations near the bounds of the schema, drawn from its fields, so that new fields are included."""

from __future__ import annotations

import math
from collections.abc import Mapping
from random import Random
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from diffdrive_mpc.mpc.config.schema import ControllerConfig
from fuzz import odd

Overrides = dict[str, Any]


def fields(schema: type[BaseModel], prefix: str = "") -> list[tuple[str, FieldInfo]]:
    """Return the fields with a single value, with their dotted keys."""
    values = []
    for name, field in schema.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            values += fields(kind, f"{prefix}{name}.")
        elif get_origin(kind) not in (list, Mapping):
            values.append((prefix + name, field))
    return values


FIELDS = [(key, field) for key, field in fields(ControllerConfig) if key not in ("model", "extra_dead_time.provenance")]
_HEAVY = {"horizon": (1, 60)}
"""Usual ranges of fields with a strong effect on the run time of a case."""


def draw_overrides(random: Random, max_count: int = 12) -> Overrides:
    """Draw values of some fields; the schema allows most of them."""
    selected = random.sample(FIELDS, random.choice((0, 1, 2, 3, random.randint(0, max_count))))
    values = {key: draw_value(random, field) for key, field in selected}
    if "horizon" in values or random.random() < 0.5:
        values["horizon"] = random.choice((1, 2, 3, 5, 15, 30, 30, random.randint(*_HEAVY["horizon"])))
        if random.random() < 0.02:
            values["horizon"] = 200
    if random.random() < 0.15:
        values["solver.method"] = random.choice(("osqp", "daqp"))
    # More iterations would only increase the run time.
    if "solver.max_iterations" in values:
        values["solver.max_iterations"] = min(values["solver.max_iterations"], 2000)
    return values


def draw_value(random: Random, field: FieldInfo) -> Any:
    """Draw a value of a field; most values are allowed."""
    kinds = get_args(field.annotation) or (field.annotation,)
    if get_origin(field.annotation) is Literal:
        return random.choice(kinds)
    optional = NoneType in kinds
    if optional and random.random() < 0.3:
        return None
    inner = next((kind for kind in kinds if kind is not NoneType and not _is_bound(kind)), float)
    base, bounds = _base(inner), _bounds(field)
    if base is bool:
        return random.random() < 0.5
    if base is str:
        return random.choice(odd.WORDS)
    low, high = bounds
    value = _number(random, low, high, field.default)
    if base is int:
        return round(value) if math.isfinite(value) and abs(value) < 1e15 else 1
    return value


def _number(random: Random, low: float, high: float, default: object) -> float:
    centre = float(default) if isinstance(default, int | float) else 1.0
    choices = [
        lambda: centre * 10.0 ** random.uniform(-3, 3),
        lambda: centre * 10.0 ** random.uniform(-1, 1),
        lambda: low if math.isfinite(low) else -1e9,
        lambda: high if math.isfinite(high) else 1e9,
        lambda: math.nextafter(low, math.inf) if math.isfinite(low) else 0.0,
        lambda: odd.number(random),
    ]
    value = random.choice(choices)()
    return value if low <= value <= high else centre


def _is_bound(kind: object) -> bool:
    return isinstance(kind, Ge | Gt | Le | Lt | FieldInfo)


def _base(kind: Any) -> type:
    inner = get_args(kind)
    while inner and not isinstance(kind, type):
        kind = inner[0]
        inner = get_args(kind)
    return kind if isinstance(kind, type) else float


def _bounds(field: FieldInfo) -> tuple[float, float]:
    items: list[object] = list(field.metadata)
    for kind in get_args(field.annotation):
        for item in getattr(kind, "__metadata__", ()):
            items += item.metadata if isinstance(item, FieldInfo) else [item]
    low, high = -math.inf, math.inf
    for item in items:
        if isinstance(item, Ge):
            low = max(low, float(item.ge))
        elif isinstance(item, Gt):
            low = max(low, math.nextafter(float(item.gt), math.inf))
        elif isinstance(item, Le):
            high = min(high, float(item.le))
        elif isinstance(item, Lt):
            high = min(high, math.nextafter(float(item.lt), -math.inf))
    return low, high
