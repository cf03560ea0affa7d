"""Parameter files of networks: YAML that says what they are and where they come from, and weights beside it."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from diffdrive_mpc.extras.networks.network import Architecture, Network
from diffdrive_mpc.extras.networks.network_model import NetworkModel, network_model
from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.structures.model_file import FunctionFile, write_parameters

_HEAD = "A network on past commands; its weights lie in the file that it names. Times [s]."
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)

_LARGEST_WEIGHTS = 500 * MEGABYTE


class NetworkFile(FunctionFile):
    """What the parameter file of a network says."""

    structure: Literal["lstm"]
    architecture: Architecture
    weights: str = Field(description="name of the file with the weights, beside this one")
    sha256: str = Field(description="of that file")

    @field_validator("weights")
    @classmethod
    def _beside(cls, name: str) -> str:
        """A log may hold this text: it must lead to no other folder."""
        if Path(name).name != name:
            raise ValueError("give the name of a file beside this one, without its folder")
        return name


def load_network(path: Path, data: Any) -> NetworkModel:  # noqa: ANN401 - what a YAML file may hold
    """The model of the network's parameter file at `path`, whose content is `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake, or the weights are missing, damaged or of another network.
    models.velocity_model.ModelError
        If it cannot be a robot's.
    """
    content = check(NetworkFile, data, str(path))
    place = path.parent / content.weights
    try:
        packed = read_input(place, _LARGEST_WEIGHTS)
    except OSError as error:
        raise ConfigError(
            f"{path}: weights: {place} cannot be read ({error.strerror or error}); keep both files together"
        ) from error
    if hashlib.sha256(packed).hexdigest() != content.sha256:
        raise ConfigError(f"{path}: sha256: {place} is not the file that was written with it; train the network again")
    try:
        with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
            network = Network(content.architecture, {name: arrays[name] for name in arrays.files})
    except (ValueError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path}: {error}") from error
    return network_model(content.name, network, content.sample_time, content.origins)


def network_content(network: Network, **fields: Any) -> NetworkFile:  # noqa: ANN401 - fields of NetworkFile
    """What the parameter file of a network says, but for the name of the file with its weights.

    Raises
    ------
    pydantic.ValidationError
        If a field is missing or wrong.
    """
    digest = hashlib.sha256(_packed(network)).hexdigest()
    kind = {"structure": "lstm", "architecture": network.architecture, "weights": "", "sha256": digest}
    return NetworkFile.model_validate({**kind, **fields})


def write_network(path: Path, network: Network, content: NetworkFile) -> None:
    """Write `content` to `path`, and the weights beside it; the same bytes each time.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    weights = path.with_suffix(".npz")
    weights.write_bytes(_packed(network))
    write_parameters(path, _HEAD, content, architecture=network.architecture.model_dump(), weights=weights.name)


def _packed(network: Network) -> bytes:
    """The weights as an npz archive, in single precision, as they were trained; without the day that it was written."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in network.weights.items():
            one = io.BytesIO()
            np.save(one, value.astype(np.float32), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _FIRST_DAY), one.getvalue())
    return whole.getvalue()
