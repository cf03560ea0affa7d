"""Velocity model that is a recurrent network on past commands, and its parameter file."""

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
from diffdrive_mpc_extras.networks.network import Architecture, Network, pack_parameters, work_size


@dataclass(frozen=True, eq=False, repr=False)
class NetworkModel(NonlinearModel):
    """`NonlinearModel` whose state is the last output of a network; build it with `network_model`.

    The output of a network is not exactly zero at zero commands; this output at rest is subtracted from each output.

    Attributes
    ----------
    network
        Network; the core evaluates it without compilation (`mpc/core/network.c`).
    """

    network: Network = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of the structure in tables and files."""
        return "lstm"

    @property
    def compiled_step(self) -> CompiledStep:
        """Compiled step, as in `NonlinearModel`; raises ModelError if the core does not support the architecture."""
        architecture = self.network.architecture
        if (architecture.layers, architecture.activation) != (1, "tanh"):
            raise ModelError(
                f"model '{self.name}': {architecture.layers} layers with {architecture.activation}; the core supports "
                "one layer with tanh only: train such a network"
            )
        parameters, size = pack_parameters(self.network), work_size(self.network)
        return CompiledStep("ddmpc_network_step", "ddmpc_network_output", parameters, size)

    @property
    def details(self) -> tuple[tuple[str, str], ...]:
        """Description of the architecture, as in `NonlinearModel`."""
        a = self.network.architecture
        layers = f"{a.window} commands, {a.layers} x LSTM of {a.units}, dense {a.dense} with {a.activation}"
        return (("network", f"{layers}: {a.parameters} parameters"),)

    @cached_property
    def _jacobians(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        # Use matrix operations (MX): the scalar graph (SX) has about a hundred thousand operations.
        window = ca.MX.sym("window", 2 * (self.memory + 1))
        jacobian = ca.Function("by", [window], [ca.jacobian(self.step(ca.MX(2, 1), window), window)])
        return np.zeros((2, 2)), jacobian(0).full().reshape(2, self.memory + 1, 2), np.eye(2)

    def simulate(
        self, commands: ArrayLike, state: ArrayLike | None = None, past: ArrayLike | None = None
    ) -> FloatArray:
        """Simulate a free run as `NonlinearModel.simulate`, with all windows evaluated at once."""
        before = np.zeros((self.memory, 2)) if past is None else np.asarray(past, dtype=float)
        # The state is the output at sample 0; commands before the past do not affect the other samples.
        outputs = self.network.simulate(commands, np.vstack([np.zeros((1, 2)), before])) - self.network.rest_output
        outputs[:1] = 0.0 if state is None else np.asarray(state, dtype=float)
        return outputs


def network_model(
    name: str, network: Network, dt: float, provenance: Mapping[str, object] | None = None
) -> NetworkModel:
    """Build the velocity model of a network with sample time `dt` [s].

    Raises
    ------
    ModelError
        If `NonlinearModel` raises it.
    """
    x, window = ca.SX.sym("x", 2), ca.MX.sym("window", 2 * network.architecture.window)
    step = ca.Function(
        "step",
        [ca.MX.sym("x", 2), window],
        [_graph(network, window) - ca.DM(network.rest_output)],
        ["x", "window"],
        ["after"],
    )
    output = ca.Function("output", [x], [x], ["x"], ["y"])
    memory = network.architecture.window - 1
    return NetworkModel(name, step, output, dt, memory, network=network, provenance=provenance or {})


def _graph(network: Network, window: ca.MX) -> ca.MX:
    """Build the symbolic output (2) of a network for a window (2 W)."""
    architecture, w = network.architecture, {name: ca.DM(value.T) for name, value in network.weights.items()}
    inputs = ca.vertsplit(window, 2)
    for layer in range(architecture.layers):
        out = cell = ca.MX(architecture.units, 1)
        offset = ca.DM(network.weights[f"gate_offset_{layer}"])
        for t, layer_input in enumerate(inputs):
            sums = w[f"input_{layer}"] @ layer_input + w[f"recurrent_{layer}"] @ out + offset
            input_gate, forget_gate, candidate, output_gate = ca.vertsplit(sums, architecture.units)
            cell = next_cell(input_gate, forget_gate, candidate, cell, ca.tanh)
            out = inputs[t] = hidden(output_gate, cell, ca.tanh)
    dense = w["dense"] @ inputs[-1] + ca.DM(network.weights["dense_offset"])
    dense = ca.tanh(dense) if architecture.activation == "tanh" else ca.fmax(dense, 0)
    return w["output"] @ dense + ca.DM(network.weights["output_offset"])


_HEAD = "Network on past commands; the file `weights` contains its weights. Times [s]."
# Constant date of the archive entries, which makes the bytes of the archive reproducible.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_MAX_ITEM_SIZE = 8
"""Maximum size of an array element [bytes]."""
_MAX_NPY_HEADER = 10_000
"""Maximum size of an array's header [bytes], as in NumPy."""
_ENCRYPTED = 1
"""Flag bit of an encrypted archive entry."""
_MAX_NAMES = 10
"""Maximum number of names in a message."""


class NetworkFile(FunctionFile):
    """Content of the parameter file of a network."""

    structure: Literal["lstm"]
    architecture: Architecture
    weights: str = Field(description="name of the file with the weights, in the folder of this file")
    sha256: str = Field(description="SHA-256 digest of the file with the weights")

    @field_validator("weights")
    @classmethod
    def _check_folder(cls, name: str) -> str:
        """Check that the name has no folder: the text may come from an untrusted log."""
        if Path(name).name != name:
            raise ValueError("give the name of a file in the folder of this file, without a folder")
        return name


def load_network(path: Path, data: Any) -> NetworkModel:  # noqa: ANN401 - content of a YAML file
    """Load the model of the network's parameter file at `path` with the content `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the content is invalid, or the weights are missing, damaged or of another network.
    models.velocity_model.ModelError
        If the model is not plausible for a robot.
    """
    content = check(NetworkFile, data, str(path))
    weights_path = path.parent / content.weights
    max_size = _MAX_ITEM_SIZE * content.architecture.parameters + file_limits().weights_spare
    try:
        archive = read_input(weights_path, max_size)
    except OSError as error:
        remedy = "train the network again" if error.errno == errno.EFBIG else "keep both files together"
        reason = error.strerror or error
        raise ConfigError(f"{path}: weights: {weights_path} cannot be read ({reason}); {remedy}") from error
    if hashlib.sha256(archive).hexdigest() != content.sha256:
        raise ConfigError(f"{path}: sha256: {weights_path} has another digest; train the network again")
    try:
        network = Network(content.architecture, _read_weights(archive, content.architecture.shapes))
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds for damaged data
        reason = " ".join(str(error).split()).removesuffix("; train the network again") or type(error).__name__
        raise ConfigError(f"{path}: weights: {weights_path}: {reason}; train the network again") from error
    return network_model(content.name, network, content.sample_time, content.origins)


def _read_weights(data: bytes, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, FloatArray]:
    """Read the arrays of an npz archive, which must contain exactly the arrays of `shapes`.

    The sizes are checked before anything is decompressed; `numpy.load` would allocate the declared sizes.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        mismatch = set(shapes) ^ set(entries)
        if mismatch:
            raise ValueError(f"arrays {', '.join(sorted(mismatch)[:_MAX_NAMES])} are missing or unknown")
        return {name: _read_array(archive, entries[name], name, shape) for name, shape in shapes.items()}


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, shape: tuple[int, ...]) -> FloatArray:
    """Read one array of an archive; never decompress more than the size of its shape."""
    count = math.prod(shape)
    if entry.flag_bits & _ENCRYPTED:
        raise ValueError(f"{name} is encrypted")
    if entry.file_size > _MAX_ITEM_SIZE * count + _MAX_NPY_HEADER:
        limit = _MAX_ITEM_SIZE * count
        raise ValueError(f"{name} has {entry.file_size:,} bytes, at most {limit:,} expected for shape {shape}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise ValueError(f"{name} has version {version} of NumPy's format, expected (1, 0)")
        header_shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
        if header_shape != shape or dtype.kind != "f" or dtype.itemsize > _MAX_ITEM_SIZE:
            raise ValueError(f"{name} has {dtype} in shape {header_shape}, expected floating-point numbers in {shape}")
        content = file.read(dtype.itemsize * count)
    if len(content) != dtype.itemsize * count:
        raise ValueError(f"{name} has {len(content):,} bytes, expected {dtype.itemsize * count:,} for shape {shape}")
    return np.frombuffer(content, dtype=dtype).reshape(shape, order="F" if is_fortran else "C")


def network_content(network: Network, **fields: Any) -> NetworkFile:  # noqa: ANN401 - fields of NetworkFile
    """Build the content of a network's parameter file, except for the name of the file with its weights.

    Raises
    ------
    pydantic.ValidationError
        If a field is missing or invalid.
    """
    digest = hashlib.sha256(_archive_bytes(network)).hexdigest()
    own_fields = {"structure": "lstm", "architecture": network.architecture, "weights": "", "sha256": digest}
    return NetworkFile.model_validate({**own_fields, **fields})


def write_network(path: Path, network: Network, content: NetworkFile) -> None:
    """Write `content` to `path`, and the weights to the same folder; the bytes are reproducible.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    weights = path.with_suffix(".npz")
    weights.write_bytes(_archive_bytes(network))
    write_parameters(path, _HEAD, content, architecture=network.architecture.model_dump(), weights=weights.name)


def _archive_bytes(network: Network) -> bytes:
    """Return the weights as an npz archive in single precision, with a constant date."""
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in network.weights.items():
            buffer = io.BytesIO()
            np.save(buffer, value.astype(np.float32), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _ZIP_DATE), buffer.getvalue())
    return output.getvalue()
