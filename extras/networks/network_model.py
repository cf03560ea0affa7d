"""A network on past commands as the velocity model of controller and plants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.extras.networks.network import Network
from diffdrive_mpc.extras.networks.packed import packed, work
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc.models.nonlinear_model import CompiledStep, NonlinearModel
from diffdrive_mpc.models.velocity_model import ModelError


@dataclass(frozen=True, eq=False, repr=False)
class NetworkModel(NonlinearModel):
    """A `NonlinearModel` whose state is the network's last output; make it with `network_model`.

    A network does not rest under commands of zero by itself, so what it says of them is taken off everything it says.

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
        # The sample 0 is the state's own; what came before the past does not matter to the others.
        outputs = self.network.simulate(commands, np.vstack([np.zeros((1, 2)), before])) - self.network.at_rest
        outputs[:1] = 0.0 if state is None else np.asarray(state, dtype=float)
        return outputs


def network_model(
    name: str, network: Network, dt: float, provenance: Mapping[str, object] | None = None
) -> NetworkModel:
    """The velocity model of a network for samples `dt` [s] apart.

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
    """Output (2) of a network for a window (2 W)."""
    architecture, w = network.architecture, {name: ca.DM(value.T) for name, value in network.weights.items()}
    said = ca.vertsplit(window, 2)
    for layer in range(architecture.layers):
        out = cell = ca.MX(architecture.units, 1)
        offset = ca.DM(network.weights[f"gate_offset_{layer}"])
        for t, given in enumerate(said):
            sums = w[f"input_{layer}"] @ given + w[f"recurrent_{layer}"] @ out + offset
            enter, keep, candidate, leave = ca.vertsplit(sums, architecture.units)
            cell = next_cell(enter, keep, candidate, cell, ca.tanh)
            out = said[t] = hidden(leave, cell, ca.tanh)
    dense = w["dense"] @ said[-1] + ca.DM(network.weights["dense_offset"])
    dense = ca.tanh(dense) if architecture.activation == "tanh" else ca.fmax(dense, 0)
    return w["output"] @ dense + ca.DM(network.weights["output_offset"])
