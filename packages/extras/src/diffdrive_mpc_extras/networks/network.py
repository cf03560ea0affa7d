"""Recurrent network on past commands: architecture, weights, evaluation with NumPy, and training windows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc.models.output_error.experiment import SampledExperiment

NETWORK = "lstm"
"""Name of the structure in files and options."""
GATES = ("input", "forget", "candidate", "output")
"""Gates of a unit, in the order of their columns."""
_CHUNK = 4096


class Architecture(StrictModel):
    """Window, layers and activation of a network as in Guffanti, Pavon, Sensors 2025, 25(18), 5821, section 3.5.

    The input is the last `window` commands (v_ref [m/s], omega_ref [rad/s]). It passes through `layers` layers of long
    short-term memory with `units` units each. The output of the last layer after the newest command passes through a
    dense layer of `dense` units with `activation`, and through a linear layer to (v [m/s], omega [rad/s]) one sample
    later. There is no feedback of the output.
    """

    window: Annotated[int, Field(ge=1, le=file_limits().window)] = 20
    units: Annotated[int, Field(ge=1, le=file_limits().units)] = 30
    dense: Annotated[int, Field(ge=1, le=file_limits().units)] = 32
    layers: Annotated[int, Field(ge=1, le=file_limits().layers)] = 1
    activation: Literal["tanh", "relu"] = "tanh"

    @model_validator(mode="after")
    def _check_multiplications(self) -> Architecture:
        limit, count = file_limits().multiplications, self.window * self.parameters
        if count > limit:
            raise ValueError(f"a step needs {count:,} multiplications, the limit is {limit:,}; train a smaller network")
        return self

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights by name; gate columns are blocks of `units`, in the order of `GATES`."""
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in range(self.layers):
            width = 2 if layer == 0 else self.units
            shapes |= {
                f"input_{layer}": (width, 4 * self.units),
                f"recurrent_{layer}": (self.units, 4 * self.units),
                f"gate_offset_{layer}": (4 * self.units,),
            }
        dense = {"dense": (self.units, self.dense), "dense_offset": (self.dense,)}
        return shapes | dense | {"output": (self.dense, 2), "output_offset": (2,)}

    @property
    def parameters(self) -> int:
        """Number of weights and offsets of the network."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())


@dataclass(frozen=True, eq=False)
class Network:
    """Architecture with weights by name, see `Architecture.shapes`.

    Raises
    ------
    ValueError
        If a weight is missing, unknown or not finite, or has a wrong shape.
    """

    architecture: Architecture
    weights: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        """Check names, shapes and values."""
        shapes = self.architecture.shapes
        mismatch = set(shapes) ^ set(self.weights)
        if mismatch:
            raise ValueError(f"weights {', '.join(sorted(mismatch))} are missing or unknown; train the network again")
        arrays = {name: np.asarray(self.weights[name], dtype=float) for name in shapes}
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ValueError(f"weights {name} have shape {arrays[name].shape}, expected {shape}")
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f"weights {name} contain a value that is not finite; train the network again")
        object.__setattr__(self, "weights", arrays)

    def __call__(self, windows: ArrayLike) -> FloatArray:
        """Compute the outputs (K, 2) for windows (K, window, 2) of commands, oldest first."""
        windows = np.asarray(windows, dtype=float)
        chunks = [self._evaluate(windows[k : k + _CHUNK]) for k in range(0, len(windows), _CHUNK)]
        return np.vstack(chunks) if chunks else np.zeros((0, 2))

    def _evaluate(self, windows: FloatArray) -> FloatArray:
        units, w = self.architecture.units, self.weights
        inputs = [windows[:, t] for t in range(windows.shape[1])]
        for layer in range(self.architecture.layers):
            out = cell = np.zeros((len(windows), units))
            for t, layer_input in enumerate(inputs):
                sums = layer_input @ w[f"input_{layer}"] + out @ w[f"recurrent_{layer}"] + w[f"gate_offset_{layer}"]
                input_gate, forget_gate, candidate, output_gate = np.split(sums, 4, axis=1)
                cell = next_cell(input_gate, forget_gate, candidate, cell, np.tanh)
                out = inputs[t] = hidden(output_gate, cell, np.tanh)
        dense = inputs[-1] @ w["dense"] + w["dense_offset"]
        dense = np.tanh(dense) if self.architecture.activation == "tanh" else np.maximum(dense, 0.0)
        return np.asarray(dense @ w["output"] + w["output_offset"])

    @property
    def rest_output(self) -> FloatArray:
        """(2,) output v [m/s] and omega [rad/s] after zero commands."""
        return np.asarray(self(np.zeros((1, self.architecture.window, 2)))[0])

    def simulate(self, commands: ArrayLike, past: ArrayLike | None = None) -> FloatArray:
        """Simulate the outputs (K, 2) for `commands` (K, 2), preceded by the commands `past` (window, 2), or zeros."""
        window = self.architecture.window
        history = np.zeros((window, 2)) if past is None else np.asarray(past, dtype=float)
        sequence = np.vstack([history, np.asarray(commands, dtype=float)])
        windows = np.lib.stride_tricks.sliding_window_view(sequence, window, axis=0)[: len(sequence) - window]
        return self(windows.transpose(0, 2, 1))


def gate_blocks(columns: FloatArray) -> Iterator[FloatArray]:
    """Yield the columns (..., units) of each gate from those of all gates (..., 4 units)."""
    yield from np.split(columns, 4, axis=-1)


BLOCK, STORED = 32, 6
"""DDMPC_BLOCK and DDMPC_STORED of `mpc/core/network.h`."""


def _round_up(count: int) -> int:
    return -(-count // BLOCK) * BLOCK


def pack_parameters(network: Network) -> FloatArray:
    """Pack the parameters (Q,) as `mpc/core/network.h` describes; subtract the output at rest from the offsets."""
    architecture, w = network.architecture, network.weights
    unit_row, dense_row, input_row = map(_round_up, (architecture.units, architecture.dense, architecture.units + 2))

    def pad(matrix: FloatArray, width: int) -> FloatArray:
        return np.pad(matrix, [*[(0, 0)] * (matrix.ndim - 1), (0, width - matrix.shape[-1])])

    def pad_gates(columns: FloatArray) -> FloatArray:
        return np.concatenate([pad(block, unit_row) for block in gate_blocks(columns)], axis=-1)

    gates = pad_gates(np.vstack([w["recurrent_0"], w["input_0"]]))
    parts = (
        np.array([architecture.window, architecture.units, architecture.dense]),
        gates,
        pad_gates(w["gate_offset_0"]),
        pad(gates.T, input_row),
        pad(w["dense"], dense_row),
        pad(w["dense_offset"], dense_row),
        pad(w["dense"].T, unit_row),
        pad(w["output"].T, dense_row),
        w["output_offset"] - network.rest_output,
    )
    return np.concatenate([np.ravel(part) for part in parts])


def work_size(network: Network) -> int:
    """Compute the size of the workspace for one step of the network in the core [reals]."""
    architecture = network.architecture
    unit_row, dense_row, input_row = map(_round_up, (architecture.units, architecture.dense, architecture.units + 2))
    forward = input_row + unit_row + len(GATES) * unit_row + 2 * dense_row
    backward = len(GATES) * unit_row + unit_row + input_row + dense_row
    return forward + backward + architecture.window * STORED * unit_row


@dataclass(frozen=True)
class Windows:
    """K windows of W commands (K, W, 2), oldest first, and the twists (K, 2) one sample after the newest command."""

    commands: FloatArray
    twists: FloatArray

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.twists)

    def part(self, first: int, stop: int) -> Windows:
        """Return the windows `first` to `stop` - 1."""
        return Windows(self.commands[first:stop], self.twists[first:stop])


def windows_of(experiments: Sequence[SampledExperiment], window: int) -> Windows:
    """Return the windows whose next sample has readings of both outputs, in temporal order.

    Raises
    ------
    ValueError
        If no experiment is longer than the window.
    """
    commands, twists = [], []
    for experiment in experiments:
        if experiment.samples <= window:
            continue
        views = np.lib.stride_tricks.sliding_window_view(experiment.inputs, window, axis=0)[:-1].transpose(0, 2, 1)
        is_complete = experiment.counts[window:].all(axis=1)
        commands.append(views[is_complete])
        twists.append(experiment.outputs[window:][is_complete])
    if not commands:
        raise ValueError(f"no part of the log is longer than the window of {window} samples; give a longer log")
    return Windows(np.concatenate(commands), np.concatenate(twists))


def fit_percent(network: Callable[[FloatArray], FloatArray], windows: Windows) -> FloatArray:
    """Compute the FIT (2,) of v and omega over windows [%], 100 (1 - |y - yhat| / |y - mean(y)|)."""
    error = np.linalg.norm(windows.twists - network(windows.commands), axis=0)
    return np.asarray(100.0 * (1.0 - error / np.linalg.norm(windows.twists - windows.twists.mean(axis=0), axis=0)))


def rmse(network: Callable[[FloatArray], FloatArray], windows: Windows) -> FloatArray:
    """Compute the root mean square error (2,) of v [m/s] and omega [rad/s] over windows."""
    return np.asarray(np.sqrt(np.mean((windows.twists - network(windows.commands)) ** 2, axis=0)))


def split_windows(windows: Windows, shares: Sequence[float]) -> tuple[Windows, ...]:
    """Split windows into consecutive parts with the given shares; parts are consecutive because windows overlap."""
    edges = [0, *np.rint(np.cumsum(shares) * len(windows)).astype(int).tolist()]
    return tuple(windows.part(first, stop) for first, stop in pairwise(edges))
