"""Base class of the groups of the configuration schema."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator

from diffdrive_mpc.models.checked_yaml import StrictModel

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

SMALLEST, LARGEST = 1e-12, 1e12
"""Sizes of numbers in a configuration, in any unit: beyond them is a mistake, and arithmetic would suffer."""


class Group(StrictModel, strict=True):
    """Base of every group: no silent conversion, so that `true` is not read as 1."""

    @field_validator("*", mode="after")
    @classmethod
    def _can_be_squared(cls, value: object) -> object:
        """Zero, or of a size that products of such numbers neither overflow nor vanish."""
        numbers = getattr(value, "sides", (value,)) if isinstance(value, float) else ()
        if any(number != 0.0 and not SMALLEST <= abs(number) <= LARGEST for number in numbers):
            raise ValueError(f"give zero or a size from {SMALLEST:g} to {LARGEST:g}, in the unit of the field")
        return value


class FeatureGroup(Group):
    """Base of the configuration group of a controller feature, written `expert.<name>`."""

    @property
    def is_enabled(self) -> bool:
        """True if the controller attaches the feature: the field `enabled`."""
        return bool(getattr(self, "enabled", True))

    def relative_to(self, folder: Path) -> Self:
        """Return the group of a configuration file in `folder`, with its relative paths resolved there."""
        del folder
        return self

    def check_files(self) -> None:
        """Raise UntrustedFileError if a file that the group names may not be opened, see `models.trust`."""
