"""What `models.plug_ins` finds of networks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.function_structure import FunctionStructure

if TYPE_CHECKING:
    from pydantic import BaseModel

    from diffdrive_mpc.extras.networks.network_model import NetworkModel
    from diffdrive_mpc.models.identification.predictor import Finder


def _load(path: Path, data: Any) -> NetworkModel:  # noqa: ANN401 - what a YAML file may hold
    from diffdrive_mpc.extras.networks.network_file import load_network  # noqa: PLC0415 - loads CasADi

    return load_network(path, data)


def _schema() -> type[BaseModel]:
    from diffdrive_mpc.extras.networks.network_file import NetworkFile  # noqa: PLC0415 - as above

    return NetworkFile


def _finder() -> Finder:
    from diffdrive_mpc.extras.networks.finding import find_network  # noqa: PLC0415 - as above
    from diffdrive_mpc.extras.networks.training import check_installed  # noqa: PLC0415

    check_installed()
    return find_network


LSTM = FunctionStructure(
    structure="lstm",
    name="lstm",
    title="LSTM",
    rank=40,
    load=_load,
    schema=_schema,
    finder=_finder,
    shipped=Path(__file__).with_name("lstm.yaml"),
    slow=True,
)
