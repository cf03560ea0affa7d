"""What a model file says about how well its numbers are known, and where the model ends."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel

Finite = Annotated[float, Field(allow_inf_nan=False)]


class CommandLimits(StrictModel):
    """Levels at which the robot clips a command by itself; a channel left out showed none."""

    v: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(default=None, description="[m/s]")
    omega: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(default=None, description="[rad/s]")


class Uncertainty(StrictModel):
    """Identified parameters with their standard deviations and correlations, SI units.

    Covariance of parameters i and j: standard_deviation[i] standard_deviation[j] correlation[i][j].
    """

    parameters: list[str]
    value: list[Finite]
    standard_deviation: list[Annotated[float, Field(ge=0, allow_inf_nan=False)]]
    correlation: list[list[Finite]]

    @model_validator(mode="after")
    def _square(self) -> Uncertainty:
        count = len(self.parameters)
        lengths = [len(self.value), len(self.standard_deviation), len(self.correlation), *map(len, self.correlation)]
        if any(length != count for length in lengths):
            raise ValueError(f"value, standard_deviation and correlation need one entry for each of {count} parameters")
        return self
