"""What the groups of the configuration's schema are made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Group(StrictModel, strict=True):
    """Base of every group: no silent conversion, so that `true` is not taken for 1."""
