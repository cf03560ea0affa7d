"""Models that predict in place of the linear one: functions of a log's samples, found beside it.

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
    """What the way from logs to a folder needs of such a model."""

    @property
    def structure(self) -> str:
        """What `--structure` calls it."""
        ...

    @property
    def title(self) -> str:
        """What it is, for a sentence: "a network"."""
        ...

    @property
    def method(self) -> str:
        """How it was found, in words."""
        ...

    @property
    def offset(self) -> FloatArray:
        """(2,) what v [m/s] and omega [rad/s] are said to be at rest: bias of the sensors, as the model has it."""
        ...

    @property
    def states(self) -> int:
        """Of the model."""
        ...

    @property
    def estimate(self) -> ParameterEstimate | None:
        """Its own parameters, where they are few enough to be read."""
        ...

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What not to trust in it."""
        ...

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """For each record v [m/s] and omega [rad/s] (K, 2) from its commands alone, sensor offsets included."""
        ...

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> NonlinearModel | None:
        """The same kind of other records of the robot; None where that is not worth its time."""
        ...

    def content(self, fields: Mapping[str, Any]) -> Any:  # noqa: ANN401 - each kind has its own file
        """What its parameter file says, `fields` being those that every file has."""
        ...

    def model(self, content: Any) -> NonlinearModel:  # noqa: ANN401
        """The velocity model of that content."""
        ...

    def write(self, path: Path, content: Any) -> None:  # noqa: ANN401
        """Write the parameter file; raises OSError where that cannot be done."""
        ...


Finder = Callable[["LogData", "Fitted"], Predictor]
"""From the training records, and the linear model of them, to a predictor."""


def finders() -> Mapping[str, Callable[[], Finder]]:
    """By what `--structure` calls them. Each raises MissingPackageError where what it needs is not installed."""
    return {one.name: one.finder for one in function_structures().values()}
