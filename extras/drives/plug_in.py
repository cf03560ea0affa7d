"""What `models.plug_ins` finds of drive models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from diffdrive_mpc.models.function_structure import FunctionStructure

if TYPE_CHECKING:
    from pydantic import BaseModel

    from diffdrive_mpc.extras.drives.drive_model import DriveModel
    from diffdrive_mpc.models.identification.predictor import Finder


def _load(path: Path, data: Any) -> DriveModel:  # noqa: ANN401 - what a YAML file may hold
    from diffdrive_mpc.extras.drives.drive_file import load_drive  # noqa: PLC0415 - loads CasADi

    return load_drive(path, data)


def _drive(name: str, structure: Literal["drive_experimental", "drive_physical"], rank: int) -> FunctionStructure:
    def schema() -> type[BaseModel]:
        from diffdrive_mpc.extras.drives.drive_file import DRIVE_FILES  # noqa: PLC0415 - as above

        return DRIVE_FILES[structure]

    def finder() -> Finder:
        from diffdrive_mpc.extras.drives.finding import drive_finder  # noqa: PLC0415 - as above

        return drive_finder(name, structure)

    shipped = Path(__file__).with_name(f"{name}.yaml")
    return FunctionStructure(structure, name, name, rank, _load, schema, finder, shipped)


PHYSICAL = _drive("p2_physical", "drive_physical", rank=10)
EXPERIMENTAL = _drive("p2_experimental", "drive_experimental", rank=20)
