"""Base classes of the groups of the configuration schema."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, field_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

MIN_SIZE, MAX_SIZE = 1e-12, 1e12
"""Range of absolute values in a configuration, in any unit; values outside are errors and could overflow."""


class Group(StrictModel, strict=True):
    """Base of all groups; implicit conversions, such as `true` to 1, are rejected."""

    def __setattr__(self, name: str, value: object) -> None:
        """Raise ConfigError, because configurations are immutable."""
        remedy = "write load_config(config, {KEY: value}) for a new one, with a dotted key such as 'weights.across'"
        raise ConfigError(f"{type(self).__name__}.{name}: {remedy}")

    @field_validator("*", mode="after")
    @classmethod
    def _check_size(cls, value: object) -> object:
        """Check that a number is zero or between `MIN_SIZE` and `MAX_SIZE`, so that products cannot overflow."""
        numbers = getattr(value, "sides", (value,)) if isinstance(value, float) else ()
        if any(number != 0.0 and not MIN_SIZE <= abs(number) <= MAX_SIZE for number in numbers):
            raise ValueError(f"give zero, or an absolute value from {MIN_SIZE:g} to {MAX_SIZE:g}, in the field's unit")
        return value


class FeatureGroup(Group):
    """Base of the configuration groups of controller features, `expert.<name>`."""

    @property
    def is_enabled(self) -> bool:
        """True if the controller attaches the feature: value of the field `enabled`, or True if there is none."""
        return bool(getattr(self, "enabled", True))

    def relative_to(self, folder: Path) -> Self:
        """Return the group with paths resolved relative to the `folder` of the configuration file."""
        del folder
        return self

    def check_files(self) -> None:
        """Raise UntrustedFileError if a file of the group is not trusted, see `models.trust`."""
