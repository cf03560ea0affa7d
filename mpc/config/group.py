"""Base class of the groups of the configuration schema."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator

from diffdrive_mpc.models.checked_yaml import StrictModel

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

MIN_SIZE, MAX_SIZE = 1e-12, 1e12
"""Range of absolute values in a configuration, in any unit; other values are mistakes and could overflow."""


class Group(StrictModel, strict=True):
    """Base of all groups, without silent conversions such as that of `true` to 1."""

    @field_validator("*", mode="after")
    @classmethod
    def _check_size(cls, value: object) -> object:
        """Check that numbers are zero, or of a size whose products neither overflow nor underflow."""
        numbers = getattr(value, "sides", (value,)) if isinstance(value, float) else ()
        if any(number != 0.0 and not MIN_SIZE <= abs(number) <= MAX_SIZE for number in numbers):
            raise ValueError(f"give zero or a size from {MIN_SIZE:g} to {MAX_SIZE:g}, in the unit of the field")
        return value


class FeatureGroup(Group):
    """Base of the configuration groups of controller features, `expert.<name>`."""

    @property
    def is_enabled(self) -> bool:
        """True if the controller attaches the feature, by the field `enabled`."""
        return bool(getattr(self, "enabled", True))

    def relative_to(self, folder: Path) -> Self:
        """Return the group with relative paths resolved in the `folder` of the configuration file."""
        del folder
        return self

    def check_files(self) -> None:
        """Raise UntrustedFileError if a file of the group is not trusted, see `models.trust`."""
