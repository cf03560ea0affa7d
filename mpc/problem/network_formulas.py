"""The formulas of a network's units with their gradients, to be generated for the core (`mpc/core/network.c`)."""

from __future__ import annotations

from functools import cache

import casadi as ca

from diffdrive_mpc.models.networks.equations import hidden, next_cell
from diffdrive_mpc.mpc.problem.formulas import differentiated


@cache
def network_formulas() -> tuple[ca.Function, ...]:
    """Cell and output of a unit, and the activation of a dense layer, as SX functions named as they are in C."""
    sums = {name: ca.SX.sym(name) for name in ("enter", "keep", "candidate", "cell")}
    leave, x = ca.SX.sym("leave"), ca.SX.sym("x")
    says = {"leave": leave, "cell": sums["cell"]}
    return (
        differentiated("ddmpc_f_cell", sums, "next_cell", next_cell(*sums.values(), ca.tanh), tuple(sums)),
        differentiated("ddmpc_f_hidden", says, "hidden", hidden(*says.values(), ca.tanh), tuple(says)),
        differentiated("ddmpc_f_dense", {"x": x}, "y", ca.tanh(x), ("x",)),
    )
