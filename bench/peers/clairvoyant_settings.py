"""Settings of the clairvoyant controller, read from `clairvoyant.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked


class ClairvoyantSettings(StrictModel):
    """How far it looks and how exactly it solves."""

    horizon: Annotated[int, Field(ge=1)]
    disturbance_memory: Annotated[float, Field(ge=0, lt=1)]
    tolerance: Annotated[float, Field(gt=0)]
    max_iterations: Annotated[int, Field(ge=1)]


@cache
def load_clairvoyant_settings(path: Path | None = None) -> ClairvoyantSettings:
    """Read a file of settings, by default the shipped one; raises ConfigError when it has a mistake."""
    return load_checked(ClairvoyantSettings, path or Path(__file__).parent / "clairvoyant.yaml")
