"""Parameter files of hybrids: the whole file of the linear model within, and the few weights of the network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.extras.hybrids.hybrid_model import Correction, HybridModel, hybrid_model
from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.files import SmFile
from diffdrive_mpc.models.structures.identified import rounded
from diffdrive_mpc.models.structures.model_file import Finite, FunctionFile, build_model, write_parameters

_HEAD = (
    "A linear model and a network on what it leaves. Features: states, v_ref [m/s] and omega_ref [rad/s] over scale."
)
Rows = Annotated[list[list[Finite]], Field(min_length=1)]


class CorrectionContent(StrictModel):
    """The network, and where it counts; see `hybrid_model.Correction`."""

    scale: list[Positive] = Field(description="usual size of each state, of v_ref and of omega_ref")
    inward: Rows = Field(description="weights from features to units [-]")
    outward: Rows = Field(description="weights from units to states [-]")
    shape: Rows = Field(description="inverse covariance of the features in the data [-]")
    full: Positive = Field(description="squared distance up to which the network counts in full [-]")
    least: Positive = Field(description="squared distance from which on it does not count [-]")

    @model_validator(mode="after")
    def _ordered(self) -> CorrectionContent:
        if not self.least > self.full:
            raise ValueError(f"least {self.least} has to be more than full {self.full}; train it again")
        for name in ("inward", "outward", "shape"):
            if len({len(row) for row in getattr(self, name)}) > 1:
                raise ValueError(f"{name} has rows of different length; train it again")
        return self

    @property
    def arrays(self) -> Correction:
        """The same as arrays."""
        return Correction(
            np.array(self.scale),
            np.array(self.inward),
            np.array(self.outward),
            np.array(self.shape),
            self.full,
            self.least,
        )


class HybridFile(FunctionFile):
    """What the parameter file of a hybrid says."""

    structure: Literal["hybrid"]
    linear: SmFile
    correction: CorrectionContent


def load_hybrid(path: Path, data: Any) -> HybridModel:  # noqa: ANN401 - what a YAML file may hold
    """The model of the parameter file at `path`, whose content is `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake.
    models.velocity_model.ModelError
        If it cannot be a robot's.
    """
    return hybrid_of(check(HybridFile, data, str(path)))


def hybrid_of(content: HybridFile) -> HybridModel:
    """The model that a parameter file describes; raises ModelError if it cannot be a robot's."""
    linear = build_model(content.linear).discretise(content.sample_time)
    return hybrid_model(content.name, linear, content.correction.arrays, content.origins)


def correction_content(correction: Correction) -> dict[str, Any]:
    """A correction as a file holds it."""
    return {name: rounded(getattr(correction, name)) for name in CorrectionContent.model_fields}


def write_hybrid(path: Path, content: HybridFile) -> None:
    """Write a parameter file; raises OSError where that cannot be done."""
    write_parameters(path, _HEAD, content)
