"""How networks are trained, read from `training.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]


class TrainingSettings(StrictModel):
    """The numbers of a training; where they come from stands in the file."""

    optimiser: Literal["adam", "rmsprop"] = Field(description="Adam, or RMSProp")
    batch: Count = Field(description="windows in a step")
    decay: float = Field(ge=0, description="L2 regularisation of weights")
    dropout: float = Field(ge=0, lt=1, description="of what the last recurrent layer says")
    validation_every: Count = Field(description="steps between two looks at the validation part")
    patience: Count = Field(description="looks without improvement until it stops")
    shares: tuple[Share, Share, Share] = Field(description="training, validation, test, in this order in time")
    rate: float = Field(gt=0, description="of the optimiser")
    most_epochs: Count
    seed: int = Field(ge=0)


@cache
def training_settings() -> TrainingSettings:
    """The shipped settings; raises ConfigError when their file has a mistake."""
    return load_checked(TrainingSettings, Path(__file__).parent / "training.yaml")
