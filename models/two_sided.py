"""Two-sided limits: one number for both sides, or one number for each side, such as `{forward: 1.0, reverse: 0.3}`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from diffdrive_mpc.models.interface import FloatArray


class TwoSided(float):
    """A two-sided limit; its value as a float is the smaller side."""

    names: ClassVar[tuple[str, str]]
    """Names of the two sides."""
    is_of_base: ClassVar[bool] = False
    """True if a file may omit a side, which is then infinite, because a base may limit only one side."""
    sides: tuple[float, float]
    """Limits of the two sides, both positive."""

    def __new__(cls, first: float, second: float | None = None) -> Self:
        """Create a limit of `first` and `second`; by default both sides are `first`."""
        sides = (float(first), float(first if second is None else second))
        limit = super().__new__(cls, min(sides))
        limit.sides = sides
        return limit

    def __reduce__(self) -> tuple[type[Self], tuple[float, float]]:
        """Copy and pickle both sides."""
        return type(self), self.sides

    def __eq__(self, limit: object) -> bool:
        """Compare both sides."""
        return self.sides == sides_of(limit) if isinstance(limit, (int, float)) else NotImplemented

    def __ne__(self, limit: object) -> bool:
        """Compare both sides, whereas `float` would compare the smaller sides."""
        return not self == limit

    # Python removes the hash of a class that defines `__eq__`.
    __hash__ = float.__hash__

    def __repr__(self) -> str:
        """Format one number, or both sides if they differ."""
        return repr(self.plain)

    def map(self, change: Callable[[float], float]) -> Self:
        """Apply `change` to each side."""
        return type(self)(*map(change, self.sides))

    @property
    def is_symmetric(self) -> bool:
        """True if both sides are equal."""
        return self.sides[0] == self.sides[1]

    @property
    def plain(self) -> float | dict[str, float]:
        """Form of the limit in files: one number, or both sides by name if they differ."""
        sides = {name: side for name, side in zip(self.names, self.sides, strict=True) if math.isfinite(side)}
        return self.sides[0] if self.is_symmetric else sides

    @classmethod
    def _read(cls, value: object) -> tuple[object, object]:
        if isinstance(value, TwoSided):
            return value.sides
        if not isinstance(value, Mapping):
            return (value, value)
        if cls.is_of_base and value and set(value) < set(cls.names):
            value = dict.fromkeys(cls.names, math.inf) | dict(value)
        if set(value) != set(cls.names):
            raise ValueError(f"give one number, or both sides: {{{cls.names[0]}: ..., {cls.names[1]}: ...}}")
        return value[cls.names[0]], value[cls.names[1]]

    @classmethod
    def __get_pydantic_core_schema__(cls, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return a schema that accepts, and serialises to, one number or a mapping with both sides."""
        return core_schema.no_info_wrap_validator_function(
            lambda value, check: cls(*map(check, cls._read(value))),
            core_schema.float_schema(gt=0, strict=True, allow_inf_nan=cls.is_of_base),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda limit: limit.plain),
        )

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Describe both forms."""
        number = {"exclusiveMinimum": 0, "type": "number"}
        sides = {
            "additionalProperties": False,
            "properties": dict.fromkeys(cls.names, number),
            **({"minProperties": 1} if cls.is_of_base else {"required": list(cls.names)}),
            "type": "object",
        }
        return {"anyOf": [number, sides]}


yaml.SafeDumper.add_multi_representer(TwoSided, lambda dumper, limit: dumper.represent_data(limit.plain))


class VelocityLimit(TwoSided):
    """Maximum speed forward and in reverse [m/s]."""

    names = ("forward", "reverse")


class YawRateLimit(TwoSided):
    """Maximum yaw rate to the left and to the right [rad/s]."""

    names = ("left", "right")


class SlewLimit(TwoSided):
    """Maximum rates at which the magnitude of a command increases and decreases [m/s^2 or rad/s^2]."""

    names = ("accelerate", "brake")


class BaseVelocityLimit(VelocityLimit):
    """Maximum speed that a base executes [m/s]."""

    is_of_base = True


class BaseYawRateLimit(YawRateLimit):
    """Maximum yaw rate that a base executes [rad/s]."""

    is_of_base = True


class BaseSlewLimit(SlewLimit):
    """Maximum rates that a base executes [m/s^2 or rad/s^2]."""

    is_of_base = True


SIDES = {name: kind.names for kind in (VelocityLimit, YawRateLimit, SlewLimit) for name in kind.names}
"""Names of both sides by the name of each side."""


def side_fields(name: str, field: FieldInfo) -> dict[str, FieldInfo]:
    """Return an optional field for each side of the limit `name`, by dotted key; empty for other fields."""
    kind = field.annotation
    if not (isinstance(kind, type) and issubclass(kind, TwoSided)):
        return {}
    number: Any = float | None
    unit = (field.description or "").rpartition("[")[2]
    return {
        f"{name}.{side}": FieldInfo.from_annotated_attribute(
            number, Field(None, gt=0, description=f"replaces {name} on this side [{unit}")
        )
        for side in kind.names
    }


def sides_of(limit: float) -> tuple[float, float]:
    """Return both sides of a limit; a plain number applies to both."""
    return limit.sides if isinstance(limit, TwoSided) else (limit, limit)


def side_of(limit: float, value: float) -> float:
    """Return the side of a limit that applies to `value`: the first if `value` is not negative."""
    return sides_of(limit)[bool(value < 0.0)]


def limit_step(last: FloatArray, command: FloatArray, increase: ArrayLike, decrease: ArrayLike) -> FloatArray:
    """Limit the step from `last` to `command` in one sample by the maximum increase and decrease of the magnitude.

    If the value crosses zero, the magnitude increases in the rest of the sample. This is the same algorithm as
    ddmpc_reach in mpc/core/limits.c.
    """
    increase, decrease = np.asarray(increase, dtype=float), np.asarray(decrease, dtype=float)
    low, high = last - np.where(last > 0.0, decrease, increase), last + np.where(last < 0.0, decrease, increase)
    low = np.where((last > 0.0) & (low < 0.0), low * (increase / decrease), low)
    high = np.where((last < 0.0) & (high > 0.0), high * (increase / decrease), high)
    return np.clip(command, low, high)


def sides_at(limit: float, values: FloatArray) -> FloatArray:
    """Return the side of a limit that applies to each of `values`."""
    first, second = sides_of(limit)
    return np.where(values < 0.0, second, first)
