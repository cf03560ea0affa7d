"""Models that replace the linear one for prediction: functions of a log's samples, identified together with it.

Limits, tracks and the poses' calibration stay those of the linear model. To add a kind: a
`models.function_structure.FunctionStructure`, registered as `models.plug_ins` says.
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
    """Interface of such a model for the pipeline from logs to a folder."""

    @property
    def structure(self) -> str:
        """Name of `--structure`."""
        ...

    @property
    def title(self) -> str:
        """Noun for sentences: "a network"."""
        ...

    @property
    def method(self) -> str:
        """Method of its identification in words."""
        ...

    @property
    def offset(self) -> FloatArray:
        """(2,) output v [m/s] and omega [rad/s] at rest: bias of the sensors, as the model has it."""
        ...

    @property
    def states(self) -> int:
        """Number of states of the model."""
        ...

    @property
    def estimate(self) -> ParameterEstimate | None:
        """Its own parameters, if they are few enough to be read."""
        ...

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the model."""
        ...

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate v [m/s] and omega [rad/s] (K, 2) of each record from its commands alone, sensor offsets included."""
        ...

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> NonlinearModel | None:
        """Fit the same kind to other records of the robot; None if that would take too long."""
        ...

    def content(self, fields: Mapping[str, Any]) -> Any:  # noqa: ANN401 - each kind has its own file
        """Return the content of its parameter file; `fields` are those of every file."""
        ...

    def model(self, content: Any) -> NonlinearModel:  # noqa: ANN401
        """Build the velocity model of that content."""
        ...

    def write(self, path: Path, content: Any) -> None:  # noqa: ANN401
        """Write the parameter file; raises OSError where that is not possible."""
        ...


Finder = Callable[["LogData", "Fitted"], Predictor]
"""From the training records, and the linear model of them, to a predictor."""


def finders() -> Mapping[str, Callable[[], Finder]]:
    """Return finders by the name of `--structure`; each raises MissingPackageError without its dependencies."""
    return {structure.name: structure.finder for structure in function_structures().values()}
