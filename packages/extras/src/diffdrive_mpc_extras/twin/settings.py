"""Priors and settings of the fit of a plant to a log, read from `settings.yaml`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


class Prior(StrictModel):
    """Prior of one parameter, and the bounds of the search.

    The search variable is z = (t(value) - t(prior)) / deviation, where t is the logarithm or the identity.
    """

    scale: Literal["log", "linear"] = Field(description="scale on which the prior is normal")
    prior: float = Field(description="median")
    deviation: Positive = Field(description="standard deviation on that scale")
    stated: Positive | None = Field(default=None, description="standard deviation if the robot file states the value")
    floor: Positive = Field(description="minimum standard deviation of an interval, on that scale")
    low: float = Field(description="minimum value")
    high: float = Field(description="maximum value")
    step: Positive = Field(description="step of finite differences, on that scale")
    unit: str
    words: str

    def z(self, value: float) -> float:
        """Convert `value` to deviations from the median of the prior."""
        if self.scale == "log":
            return float(np.log(value / self.prior)) / self.deviation
        return (value - self.prior) / self.deviation

    def value(self, z: float) -> float:
        """Convert deviations from the median of the prior to a value."""
        if self.scale == "log":
            return self.prior * float(np.exp(self.deviation * z))
        return self.prior + self.deviation * z

    def with_median(self, prior: float | None = None, *, stated: bool = False) -> Prior:
        """Return a copy with another median; `stated` selects the narrower deviation."""
        changes: dict[str, float] = {} if prior is None else {"prior": prior}
        if stated and self.stated is not None:
            changes["deviation"] = self.stated
        return self.model_copy(update=changes)


class TwinSettings(StrictModel):
    """Settings of the fit; `settings.yaml` describes the fields."""

    parameters: dict[str, Prior]
    sensors: list[str]
    wheel_base_share: Positive
    encoder_pulses: Positive
    speed_margin: Positive
    limit_margin: Positive
    window: Positive
    seconds: Positive
    lead: Positive
    settle: Positive
    longest_hold: Positive
    evaluations: tuple[int, int]
    refined: int
    told: Annotated[float, Field(gt=0, lt=1)]
    block: Positive
    interval: Positive


@cache
def twin_settings() -> TwinSettings:
    """Read `settings.yaml`; raises ConfigError if it is invalid."""
    return load_checked(TwinSettings, Path(__file__).with_name("settings.yaml"))
