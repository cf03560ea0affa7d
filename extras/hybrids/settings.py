"""How the network of a hybrid is trained, read from `training.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(gt=0, lt=1)]


class HybridSettings(StrictModel):
    """The numbers of a training."""

    units: Count = Field(description="of the one layer")
    full: Share = Field(description="share of the rows at which the network counts in full [-]")
    reach: float = Field(gt=1, description="distance at which it no longer counts, over that of full share [-]")
    decays: tuple[Positive, ...] = Field(min_length=1, description="penalties of squared weights, the strongest first")
    most_steps: Count = Field(description="of one search")
    least_gain: Share = Field(description="fall of the error power of held-out blocks that it has to bring [-]")
    seed: int = Field(ge=0)


@cache
def hybrid_settings() -> HybridSettings:
    """Read the file; raises ConfigError on a mistake in it."""
    return load_checked(HybridSettings, Path(__file__).with_name("training.yaml"))
