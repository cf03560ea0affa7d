"""What an identification returns, whatever the structure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.output_error.linear_system import LinearSystem
from diffdrive_mpc.models.identification.output_error.solve import OutputErrorFit
from diffdrive_mpc.models.identification.signals import YawSource
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import build_model
from diffdrive_mpc.models.structures import STRUCTURES, ModelFile
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel

# The file carries this many digits: far finer than any standard deviation.
_DIGITS = 8


@dataclass(frozen=True)
class IdentifiedModel:
    """An identified velocity model.

    Attributes
    ----------
    structure
        "mbm", "sm" or "ssm".
    content
        Those keys of the parameter file that hold the dynamics, numbers rounded as the file holds them.
    parameters
        What was estimated, with covariance; SI units.
    offset
        (2,) sensor bias of v [m/s] and omega [rad/s], to be added to the model's outputs when compared with the log.
    limits
        Level of each channel at which the robot clips its command, where the data show one.
    yaw
        Whether omega was the gyro's or the encoders'.
    method
        How it was done, in words.
    fits
        The estimates behind it: of each channel, or one.
    warnings
        What not to trust.
    """

    structure: str
    content: Mapping[str, Any]
    parameters: Estimate
    offset: FloatArray
    limits: Mapping[str, float]
    yaw: YawSource
    method: str
    fits: tuple[OutputErrorFit, ...]
    warnings: tuple[str, ...]

    @property
    def model(self) -> VelocityModel:
        """The velocity model; raises ModelError if its numbers cannot be a robot's."""
        return build_model(self.file("identified", {"origin": "identified", "source": self.method}))

    @property
    def system(self) -> LinearSystem:
        """The model with its sensor offsets and limits, as it is held against a log."""
        data = self.file("identified", {"origin": "identified", "source": self.method})
        limit = np.array([self.limits.get(channel, np.inf) for channel in CHANNELS])
        dead_time = np.array([data.dead_time.v, data.dead_time.omega])
        return LinearSystem(*data.matrices(), dead_time, self.offset, limit)

    def file(self, name: str, provenance: Mapping[str, Any], **more: object) -> ModelFile:
        """The content of a parameter file; `more` are further keys of it."""
        return STRUCTURES[self.structure].model_validate(
            {"name": name, "structure": self.structure, "provenance": provenance, **self.content, **more}
        )


def rounded(value: object) -> Any:  # noqa: ANN401 - numbers in any nesting, as YAML takes them
    """Numbers, or arrays or mappings of them, as plain Python numbers with the digits that a file carries."""
    if isinstance(value, Mapping):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [rounded(entry) for entry in value]
    return float(f"{float(value):.{_DIGITS}g}")  # type: ignore[arg-type]
