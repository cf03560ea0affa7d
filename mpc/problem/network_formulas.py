"""The formulas of a network's units with their gradients, to be generated for the core (`mpc/core/network.c`)."""

from __future__ import annotations

from functools import cache

import casadi as ca

from diffdrive_mpc.models.lstm_cell import hidden, next_cell
from diffdrive_mpc.mpc.problem.formulas import differentiated


@cache
def network_formulas() -> tuple[ca.Function, ...]:
    """Cell and output of a unit, and the activation of a dense layer, as SX functions named as they are in C."""
    names = ("enter", "keep", "candidate", "leave", "cell", "x")
    enter, keep, candidate, leave, cell, x = (ca.SX.sym(name) for name in names)
    before = {"enter": enter, "keep": keep, "candidate": candidate, "cell": cell}
    now = {"leave": leave, "cell": cell}
    after = next_cell(enter, keep, candidate, cell, ca.tanh)
    return (
        differentiated("ddmpc_f_cell", before, "next_cell", after, tuple(before)),
        differentiated("ddmpc_f_hidden", now, "hidden", hidden(leave, cell, ca.tanh), tuple(now)),
        differentiated("ddmpc_f_dense", {"x": x}, "y", ca.tanh(x), ("x",)),
    )
