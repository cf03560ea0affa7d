"""A drive model from records: what the log tells, and what keeps its prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.extras.drives.content import drive_content
from diffdrive_mpc.extras.drives.drive_file import ExperimentalFile, PhysicalFile, drive_of, write_drive
from diffdrive_mpc.extras.drives.drive_model import DriveModel, Kind
from diffdrive_mpc.extras.drives.equations import STATES
from diffdrive_mpc.extras.drives.fitting import fit_drive
from diffdrive_mpc.extras.drives.priors import ToldDrive, refitted, told_by
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.identification.predictor import Finder
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.logs.geometry import WheelGeometry
from diffdrive_mpc.models.output_error.doubts import badly_known
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate

_METHOD = (
    "least squares on the free run, two starts, dead time in samples searched downhill; a number that the log does not "
    "tell keeps its prior"
)
_UNTOLD = {
    "quicker": "a slope limit when speeding up is not seen: none is modelled",
    "slower": "a slope limit when slowing down is not seen: none is modelled",
    "threshold": "standstill after a change of direction is not seen: its threshold stays 0",
    "threshold_by_slope": "growth of the threshold with the slope is not seen: it stays 0",
    "integral_time": "the integral time is not told by the log: it stays the paper's 4.58 s",
}
_KINDS = {"gain": "gain", "lag": "lag", "stiffness": "lag"}
"""Kind of doubt where a number is badly known."""


@dataclass(frozen=True)
class FoundDrive:
    """A drive as `identification.predictor.Predictor`.

    Attributes
    ----------
    structure
        As `models list` calls it.
    told
        The model, and what the log says of it.
    geometry
        Of the log's wheels; None without any.
    """

    structure: str
    told: ToldDrive
    geometry: WheelGeometry | None
    title: str = "a drive"
    method: str = _METHOD
    states: int = 2 * STATES

    @property
    def offset(self) -> FloatArray:
        """See `Predictor`."""
        return np.array([values.get("offset", 0.0) for values in self.told.fit.values])

    @property
    def estimate(self) -> ParameterEstimate:
        """See `Predictor`."""
        return self.told.estimate

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """See `Predictor`."""
        found = []
        for name in self.told.kept:
            channel, _, last = name.rpartition(".")
            doubt = Doubt("prior kept", _UNTOLD[last])
            found.append(doubt.of(channel) if channel else doubt)
        for name in self.told.at_bound:
            found.append(Doubt("effect", f"{name} lies on a bound of the search: the data do not determine it"))
        # A dead time or an offset may be near zero; what has a prior is known, or it would be kept.
        sized = [name for name in self.estimate.names if name.rpartition(".")[2] in _KINDS]
        for name in sized:
            found += badly_known(self.estimate.part([name]), _KINDS[name.rpartition(".")[2]])
        return tuple(found)

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """See `Predictor`."""
        return self.told.fit.simulate(records, yaw)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> DriveModel:
        """See `Predictor`: dead times and priors as they were."""
        records = most_informative(records, identification_settings().most_rows["effects"])
        return refitted(self.told, records, yaw).model(f"{self.structure} of the data held out")

    def content(self, fields: Mapping[str, Any]) -> ExperimentalFile | PhysicalFile:
        """See `Predictor`."""
        return drive_content(self.told.fit, fields, self.geometry)

    def model(self, content: ExperimentalFile | PhysicalFile) -> DriveModel:
        """See `Predictor`."""
        return drive_of(content)

    def write(self, path: Path, content: ExperimentalFile | PhysicalFile) -> None:
        """See `Predictor`."""
        write_drive(path, content)


def drive_finder(name: str, kind: Kind) -> Finder:
    """What fits the drive that `models list` calls `name` to training records: of long ones a part, as effects."""

    def find(data: LogData, fitted: Fitted) -> FoundDrive:
        records = most_informative(data.train, identification_settings().most_rows["effects"])
        yaw = fitted.identified.yaw
        told = told_by(fit_drive(kind, records, yaw), records, yaw)
        return FoundDrive(name, told, fitted.geometry)

    return find


find_physical = drive_finder("p2_physical", "drive_physical")
find_experimental = drive_finder("p2_experimental", "drive_experimental")
