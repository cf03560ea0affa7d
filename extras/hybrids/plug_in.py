"""What `models.plug_ins` finds of hybrids."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.function_structure import FunctionStructure

if TYPE_CHECKING:
    from pydantic import BaseModel

    from diffdrive_mpc.extras.hybrids.hybrid_model import HybridModel
    from diffdrive_mpc.models.identification.predictor import Finder


def _load(path: Path, data: Any) -> HybridModel:  # noqa: ANN401 - what a YAML file may hold
    from diffdrive_mpc.extras.hybrids.hybrid_file import load_hybrid  # noqa: PLC0415 - loads CasADi

    return load_hybrid(path, data)


def _schema() -> type[BaseModel]:
    from diffdrive_mpc.extras.hybrids.hybrid_file import HybridFile  # noqa: PLC0415 - as above

    return HybridFile


def _finder() -> Finder:
    from diffdrive_mpc.extras.hybrids.finding import find_hybrid  # noqa: PLC0415 - as above
    from diffdrive_mpc.extras.hybrids.training import libraries  # noqa: PLC0415

    libraries()
    return find_hybrid


HYBRID = FunctionStructure(
    structure="hybrid",
    name="hybrid",
    title="hybrid",
    rank=30,
    load=_load,
    schema=_schema,
    finder=_finder,
    slow=True,
)
