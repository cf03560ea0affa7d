"""A network on past commands as the velocity model of controller and plants."""

from __future__ import annotations

import errno
import hashlib
import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import read_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc.models.nonlinear_model import CompiledStep, NonlinearModel
from diffdrive_mpc.models.structures.model_file import FunctionFile, write_parameters
from diffdrive_mpc.models.velocity_model import ModelError
from diffdrive_mpc_extras.networks.network import Architecture, Network, packed, work


@dataclass(frozen=True, eq=False, repr=False)
class NetworkModel(NonlinearModel):
    """A `NonlinearModel` whose state is the network's last output; make it with `network_model`.

    A network does not rest under commands of zero by itself, so its output for them is subtracted from every output.

    Attributes
    ----------
    network
        The network, which the core evaluates without compiling anything (`mpc/core/network.c`).
    """

    network: Network = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of its kind for tables and files."""
        return "lstm"

    @property
    def compiled_step(self) -> CompiledStep:
        """See `NonlinearModel`; raises ModelError if it is a network of a kind that the core does not have."""
        kind = self.network.architecture
        if (kind.layers, kind.activation) != (1, "tanh"):
            raise ModelError(
                f"model '{self.name}': {kind.layers} layers with {kind.activation}; the core has networks of one layer "
                "with tanh: train one of those to drive with"
            )
        return CompiledStep("ddmpc_network_step", "ddmpc_network_output", packed(self.network), work(self.network))

    @property
    def details(self) -> tuple[tuple[str, str], ...]:
        """See `NonlinearModel`."""
        kind = self.network.architecture
        words = (
            f"{kind.window} commands, {kind.layers} x LSTM of {kind.units}, dense {kind.dense} with {kind.activation}"
        )
        return (("network", f"{words}: {kind.parameters} parameters"),)

    @cached_property
    def _jacobians(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        # By its graph of matrices: written out in numbers it would be a hundred thousand operations.
        window = ca.MX.sym("window", 2 * (self.memory + 1))
        by_window = ca.Function("by", [window], [ca.jacobian(self.step(ca.MX(2, 1), window), window)])
        return np.zeros((2, 2)), by_window(0).full().reshape(2, self.memory + 1, 2), np.eye(2)

    def simulate(
        self, commands: ArrayLike, state: ArrayLike | None = None, past: ArrayLike | None = None
    ) -> FloatArray:
        """Free run from commands alone; as `NonlinearModel.simulate`, all windows at once."""
        before = np.zeros((self.memory, 2)) if past is None else np.asarray(past, dtype=float)
        # The sample 0 is the state's own; values before the past do not affect the others.
        outputs = self.network.simulate(commands, np.vstack([np.zeros((1, 2)), before])) - self.network.at_rest
        outputs[:1] = 0.0 if state is None else np.asarray(state, dtype=float)
        return outputs


def network_model(
    name: str, network: Network, dt: float, provenance: Mapping[str, object] | None = None
) -> NetworkModel:
    """Build the velocity model of a network for samples `dt` [s] apart.

    Raises
    ------
    ModelError
        As `NonlinearModel`.
    """
    x, window = ca.SX.sym("x", 2), ca.MX.sym("window", 2 * network.architecture.window)
    step = ca.Function(
        "step",
        [ca.MX.sym("x", 2), window],
        [_graph(network, window) - ca.DM(network.at_rest)],
        ["x", "window"],
        ["after"],
    )
    output = ca.Function("output", [x], [x], ["x"], ["y"])
    memory = network.architecture.window - 1
    return NetworkModel(name, step, output, dt, memory, network=network, provenance=provenance or {})


def _graph(network: Network, window: ca.MX) -> ca.MX:
    """Build the output (2) of a network for a window (2 W)."""
    architecture, w = network.architecture, {name: ca.DM(value.T) for name, value in network.weights.items()}
    inputs = ca.vertsplit(window, 2)
    for layer in range(architecture.layers):
        out = cell = ca.MX(architecture.units, 1)
        offset = ca.DM(network.weights[f"gate_offset_{layer}"])
        for t, layer_input in enumerate(inputs):
            sums = w[f"input_{layer}"] @ layer_input + w[f"recurrent_{layer}"] @ out + offset
            enter, keep, candidate, leave = ca.vertsplit(sums, architecture.units)
            cell = next_cell(enter, keep, candidate, cell, ca.tanh)
            out = inputs[t] = hidden(leave, cell, ca.tanh)
    dense = w["dense"] @ inputs[-1] + ca.DM(network.weights["dense_offset"])
    dense = ca.tanh(dense) if architecture.activation == "tanh" else ca.fmax(dense, 0)
    return w["output"] @ dense + ca.DM(network.weights["output_offset"])


# Parameter files of networks: YAML that says what they are and where they come from, and weights beside it.


_HEAD = "A network on past commands; its weights lie in the file that it names. Times [s]."
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)
_DOUBLE = 8
"""Bytes of a number at most."""
_NPY_HEADER = 10_000
"""Bytes of an array's header at most; NumPy reads no longer one, either."""
_ENCRYPTED = 1
"""Bit of an archive's entry."""
_SHOWN = 10
"""Names that a message lists."""


class NetworkFile(FunctionFile):
    """Content of the parameter file of a network."""

    structure: Literal["lstm"]
    architecture: Architecture
    weights: str = Field(description="name of the file with the weights, beside this one")
    sha256: str = Field(description="of that file")

    @field_validator("weights")
    @classmethod
    def _beside(cls, name: str) -> str:
        """Check that the name is that of a file in the same folder: a log may hold this text."""
        if Path(name).name != name:
            raise ValueError("give the name of a file beside this one, without its folder")
        return name


def load_network(path: Path, data: Any) -> NetworkModel:  # noqa: ANN401 - what a YAML file may hold
    """Load the model of the network's parameter file at `path` with the content `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake, or the weights are missing, damaged or of another network.
    models.velocity_model.ModelError
        If it cannot be a robot's.
    """
    content = check(NetworkFile, data, str(path))
    place = path.parent / content.weights
    largest = _DOUBLE * content.architecture.parameters + file_limits().weights_spare
    try:
        packed = read_input(place, largest)
    except OSError as error:
        remedy = "train the network again" if error.errno == errno.EFBIG else "keep both files together"
        raise ConfigError(f"{path}: weights: {place} cannot be read ({error.strerror or error}); {remedy}") from error
    if hashlib.sha256(packed).hexdigest() != content.sha256:
        raise ConfigError(f"{path}: sha256: {place} is not the file that was written with it; train the network again")
    try:
        network = Network(content.architecture, _unpacked(packed, content.architecture.shapes))
    except Exception as error:  # zipfile, zlib and NumPy have many for damaged bytes
        words = " ".join(str(error).split()).removesuffix("; train the network again") or type(error).__name__
        raise ConfigError(f"{path}: weights: {place}: {words}; train the network again") from error
    return network_model(content.name, network, content.sample_time, content.origins)


def _unpacked(packed: bytes, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, FloatArray]:
    """Unpack the arrays of an npz archive, which must contain numbers in these shapes and nothing else.

    NumPy would allocate and unpack the declared size: here sizes are counted from its directory first.
    """
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        odd = set(shapes) ^ set(entries)
        if odd:
            raise ValueError(f"arrays {', '.join(sorted(odd)[:_SHOWN])} are missing or unknown")
        return {name: _array(archive, entries[name], name, shape) for name, shape in shapes.items()}


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, shape: tuple[int, ...]) -> FloatArray:
    """Read one array of an archive; never unpack more than its shape needs."""
    count = math.prod(shape)
    if entry.flag_bits & _ENCRYPTED:
        raise ValueError(f"{name} is encrypted")
    if entry.file_size > _DOUBLE * count + _NPY_HEADER:
        raise ValueError(f"{name} unpacks to {entry.file_size:,} bytes, its shape {shape} takes {_DOUBLE * count:,}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise ValueError(f"{name} is of version {version} of NumPy's format, expected (1, 0)")
        stated, fortran, kind = np.lib.format.read_array_header_1_0(file)
        if stated != shape or kind.kind != "f" or kind.itemsize > _DOUBLE:
            raise ValueError(f"{name} holds {kind} in shape {stated}, expected floating-point numbers in {shape}")
        content = file.read(kind.itemsize * count)
    if len(content) != kind.itemsize * count:
        raise ValueError(f"{name} holds {len(content):,} bytes, its shape {shape} takes {kind.itemsize * count:,}")
    return np.frombuffer(content, dtype=kind).reshape(shape, order="F" if fortran else "C")


def network_content(network: Network, **fields: Any) -> NetworkFile:  # noqa: ANN401 - fields of NetworkFile
    """Build the content of a network's parameter file, except for the name of the file with its weights.

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
    """Pack the weights as an npz archive in single precision, without a date."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in network.weights.items():
            buffer = io.BytesIO()
            np.save(buffer, value.astype(np.float32), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _FIRST_DAY), buffer.getvalue())
    return whole.getvalue()
