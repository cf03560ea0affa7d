"""What every model parameter file has, whatever the structure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

import yaml
from pydantic import Field, model_validator

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.editor_line import kept_editor_line
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel

Matrices = tuple[FloatArray, FloatArray, FloatArray]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


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


class Provenance(StrictModel):
    """Where the numbers of a parameter file come from."""

    origin: Literal["published", "identified", "assumed"] = Field(
        description="'published' only if the numbers stand in a paper's text; 'assumed' if nobody measured them"
    )
    source: str = Field(description="paper and place, or robot or plant the experiments were run on")
    method: str = ""
    experiments: list[str] = Field(default_factory=list)
    date: str = ""
    notes: str = ""


class ChannelFit(StrictModel):
    """FIT = 100 (1 - |y - yhat| / |y - mean(y)|) of each channel [%]."""

    v: Finite
    omega: Finite


class DeadTime(StrictModel):
    """Dead time of each input [s]."""

    v: Seconds = 0.0
    omega: Seconds = 0.0


class ParameterFile(StrictModel):
    """What every parameter file of a velocity model has, of a linear one or of a function."""

    name: str
    structure: str
    provenance: Provenance
    fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of the stated experiments")
    validation_fit_percent: ChannelFit | None = Field(default=None, description="simulation FIT of records held out")
    limits: CommandLimits | None = Field(default=None, description="levels at which the robot clips a command")
    warnings: list[str] = Field(default_factory=list, description="what the identification did not trust")

    @property
    def origins(self) -> dict[str, object]:
        """Provenance and warnings, as a model carries them."""
        return self.provenance.model_dump() | {"warnings": self.warnings}


class FunctionFile(ParameterFile):
    """What every file of a model that is a function of samples has."""

    sample_time: Annotated[float, Field(gt=0, allow_inf_nan=False)] = Field(description="of commands and outputs [s]")


class ModelFile(ParameterFile):
    """What every file of a linear model has. A structure narrows `structure` to its name, as a Literal."""

    uncertainty: Uncertainty | None = Field(default=None, description="how well the identified parameters are known")
    dead_time: DeadTime = DeadTime()
    base_effects: BaseEffects = Field(default=BaseEffects(), description="what the base does around the linear model")

    def matrices(self) -> Matrices:
        """Continuous A (n, n), B (n, 2), C (2, n)."""
        raise TypeError("ModelFile only holds what the structures share")


def build_model(data: ModelFile) -> VelocityModel:
    """The model that the content of a parameter file describes; raises ModelError if it cannot be a robot's."""
    A, B, C = data.matrices()
    return VelocityModel(
        name=data.name,
        structure=data.structure,
        A=A,
        B=B,
        C=C,
        dead_time=[data.dead_time.v, data.dead_time.omega],  # type: ignore[arg-type]  # converted on construction
        provenance=data.origins,
    )


def write_parameters(path: Path, head: str, content: ParameterFile, **more: object) -> None:
    """Write a parameter file: a line of comment, what it is and where it comes from, its numbers, `more`.

    What is at its default is left out; the line for editors of a file that was there stays. Raises OSError if the file
    cannot be written.
    """
    data = content.model_dump(exclude_none=True, exclude_defaults=True) | more
    first = list(ParameterFile.model_fields)
    ordered = {key: data[key] for key in first if key in data}
    ordered |= {key: value for key, value in data.items() if key not in (*first, "uncertainty")}
    ordered |= {key: data[key] for key in ("uncertainty",) if key in data}
    text = yaml.safe_dump(ordered, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
    path.write_text(f"{kept_editor_line(path)}# {head}\n{text}", encoding="utf-8")


def structure_name(schema: type[ModelFile]) -> str:
    """The name to which a schema narrows `structure`."""
    (name,) = get_args(schema.model_fields["structure"].annotation)
    return str(name)
