"""Nonlinear models that the core brings compiled: their functions, the numbers that they take, and their memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.networks.network import GATES, Network, gate_blocks
from diffdrive_mpc.models.networks.network_model import NetworkModel
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel

BLOCK, KEPT = 32, 6
"""DDMPC_BLOCK and DDMPC_KEPT of `mpc/core/network.h`."""


@dataclass(frozen=True)
class BuiltIn:
    """A nonlinear model in the core.

    Attributes
    ----------
    step, output
        Names of its functions in C.
    parameters
        (Q,) numbers that they take.
    work
        Reals of memory that the step needs.
    """

    step: str
    output: str
    parameters: FloatArray
    work: int


def built_in(model: VelocityModel | DiscreteModel | NonlinearModel) -> BuiltIn | None:
    """What the core has for `model`; None for a linear one and for the user's own functions.

    Raises
    ------
    ModelError
        If it is a network of a kind that the core does not have.
    """
    if not isinstance(model, NetworkModel):
        return None
    kind = model.network.architecture
    if (kind.layers, kind.activation) != (1, "tanh"):
        raise ModelError(
            f"model '{model.name}': {kind.layers} layers with {kind.activation}; the core has networks of one layer "
            "with tanh: train one of those to drive with"
        )
    work = _work(model.network)
    return BuiltIn("ddmpc_network_step", "ddmpc_network_output", _packed(model.network), work)


def _padded(count: int) -> int:
    return -(-count // BLOCK) * BLOCK


def _packed(network: Network) -> FloatArray:
    """The parameters in the order of network.h. What the network says at rest is taken off its offsets."""
    kind, w = network.architecture, network.weights
    unit_row, dense_row, in_row = _padded(kind.units), _padded(kind.dense), _padded(kind.units + 2)

    def rows(matrix: FloatArray, width: int) -> FloatArray:
        return np.pad(matrix, [*[(0, 0)] * (matrix.ndim - 1), (0, width - matrix.shape[-1])])

    def by_gate(columns: FloatArray) -> FloatArray:
        return np.concatenate([rows(block, unit_row) for block in gate_blocks(columns)], axis=-1)

    gates = by_gate(np.vstack([w["recurrent_0"], w["input_0"]]))
    parts = (
        np.array([kind.window, kind.units, kind.dense]),
        gates,
        by_gate(w["gate_offset_0"]),
        rows(gates.T, in_row),
        rows(w["dense"], dense_row),
        rows(w["dense_offset"], dense_row),
        rows(w["dense"].T, unit_row),
        rows(w["output"].T, dense_row),
        w["output_offset"] - network.at_rest,
    )
    return np.concatenate([np.ravel(part) for part in parts])


def _work(network: Network) -> int:
    kind = network.architecture
    unit_row, dense_row, in_row = _padded(kind.units), _padded(kind.dense), _padded(kind.units + 2)
    forward = in_row + unit_row + len(GATES) * unit_row + 2 * dense_row
    back = len(GATES) * unit_row + unit_row + in_row + dense_row
    return forward + back + kind.window * KEPT * unit_row
