"""Models that predict in place of the linear one: functions of a log's samples, found beside it.

Limits, tracks and the poses' calibration stay those of the linear model. To add a kind: its module with a `Predictor`
and a function as in `finders`, and its line there; `models/load.py` reads its file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import DRIVES, HYBRID
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.networks.network import NETWORK
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.fitting import Fitted
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


def _network() -> Finder:
    from diffdrive_mpc.models.identification.network import find_network  # noqa: PLC0415 - others do without it
    from diffdrive_mpc.models.networks.training import check_installed  # noqa: PLC0415

    check_installed()
    return find_network


def _hybrid() -> Finder:
    from diffdrive_mpc.models.hybrids.training import libraries  # noqa: PLC0415 - as above
    from diffdrive_mpc.models.identification.hybrid import find_hybrid  # noqa: PLC0415

    libraries()
    return find_hybrid


def _drive(structure: str) -> Callable[[], Finder]:
    def finder() -> Finder:
        from diffdrive_mpc.models.identification.drive import drive_finder  # noqa: PLC0415 - loads CasADi

        return drive_finder(structure)

    return finder


finders: Mapping[str, Callable[[], Finder]] = {
    NETWORK: _network,
    HYBRID: _hybrid,
    **{name: _drive(name) for name in DRIVES},
}
"""By what `--structure` calls them. Each raises MissingPackageError where what it needs is not installed."""


def with_predictor(data: LogData, fitted: Fitted, find: Finder) -> Fitted:
    """`fitted` with a predictor found on the same records, and its scores and outputs in place of the linear model's.

    The records held out are not looked at.

    Raises
    ------
    models.errors.MissingPackageError
        If what finds it is not installed.
    ValueError
        If the records are too few.
    """
    from diffdrive_mpc.models.identification.fitting import scored  # noqa: PLC0415 - it imports this module

    started = perf_counter()
    found = find(data, fitted)
    seconds = perf_counter() - started
    yaw = fitted.identified.yaw
    simulated = [found.simulate(records, yaw) for records in (data.train, data.validation)]
    both = ((data.train, "training"), (data.validation, "validation"))
    scores = [scored(outputs, records, yaw, name) for outputs, (records, name) in zip(simulated, both, strict=True)]
    return replace(
        fitted,
        predictor=found,
        train=scores[0],
        validation=scores[1],
        simulated=tuple(simulated[1]),
        seconds=fitted.seconds + seconds,
    )
