"""Predictors: models such as networks that are identified in addition to the linear model and replace its predictions.

The linear model still determines limits, tracks and calibration from poses. To add a kind of predictor, register a
`models.function_structure.FunctionStructure` as described in `models.plug_ins`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.fit.fitting import Fitted
    from diffdrive_mpc.models.identification.log_data import LogData


class Predictor(Protocol):
    """Interface of a predicting model for the identification from logs."""

    @property
    def structure(self) -> str:
        """Name of the structure in `--structure`."""
        ...

    @property
    def title(self) -> str:
        """Noun for sentences, such as "a network"."""
        ...

    @property
    def method(self) -> str:
        """Description of the identification method."""
        ...

    @property
    def offset(self) -> FloatArray:
        """Sensor bias (2,) of the model: outputs v [m/s] and omega [rad/s] at rest."""
        ...

    @property
    def states(self) -> int:
        """Number of states of the model."""
        ...

    @property
    def estimate(self) -> ParameterEstimate | None:
        """Parameters of the model; None if there are too many for a table."""
        ...

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the model."""
        ...

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate v [m/s] and omega [rad/s] (K, 2) of each record from its commands, including sensor offsets."""
        ...

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> NonlinearModel | None:
        """Fit a model of this kind to other records of the robot; None if the fit takes too long."""
        ...

    def content(self, fields: Mapping[str, Any]) -> Any:  # noqa: ANN401 - each kind has its own file
        """Return the content of the parameter file; `fields` are the fields that are common to all parameter files."""
        ...

    def model(self, content: Any) -> NonlinearModel:  # noqa: ANN401
        """Build the velocity model from the content of its parameter file."""
        ...

    def write(self, path: Path, content: Any) -> None:  # noqa: ANN401
        """Write the parameter file; raise OSError on failure."""
        ...


Finder = Callable[["LogData", "Fitted"], Predictor]
"""Function that identifies a predictor from the logs and the linear model."""


def finders() -> Mapping[str, Callable[[], Finder]]:
    """Return the loader of each finder by structure name; it raises MissingPackageError for a missing package."""
    return {structure.name: structure.finder for structure in function_structures().values()}
