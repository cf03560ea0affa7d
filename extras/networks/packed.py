"""A network's numbers in the order of `mpc/core/network.h`, and the memory that its step needs there."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.extras.networks.network import GATES, Network, gate_blocks
from diffdrive_mpc.models.interface import FloatArray

BLOCK, KEPT = 32, 6
"""DDMPC_BLOCK and DDMPC_KEPT of `mpc/core/network.h`."""


def _padded(count: int) -> int:
    return -(-count // BLOCK) * BLOCK


def packed(network: Network) -> FloatArray:
    """(Q,) the parameters. What the network says at rest is taken off its offsets."""
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


def work(network: Network) -> int:
    """Reals of memory that the step needs."""
    kind = network.architecture
    unit_row, dense_row, in_row = _padded(kind.units), _padded(kind.dense), _padded(kind.units + 2)
    forward = in_row + unit_row + len(GATES) * unit_row + 2 * dense_row
    back = len(GATES) * unit_row + unit_row + in_row + dense_row
    return forward + back + kind.window * KEPT * unit_row
