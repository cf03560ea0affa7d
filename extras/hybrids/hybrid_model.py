"""A linear model with a small network on what it leaves, as the velocity model of controller and plants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca

from diffdrive_mpc.extras.hybrids.equations import gate, network
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import ModelError


@dataclass(frozen=True, eq=False)
class Correction:
    """A network on n states and two commands, and where it counts.

    Attributes
    ----------
    scale
        (n + 2,) usual size of the states and of v_ref [m/s], omega_ref [rad/s]; features are these over their size.
    inward, outward
        (n + 2, units), (units, n) weights; what comes out adds to the states in units of their size.
    shape
        (n + 2, n + 2) inverse covariance of the features in the data.
    full, least
        Squared distances from rest by that shape: up to the first the network counts in full, from the second on not
        at all [-].
    """

    scale: FloatArray
    inward: FloatArray
    outward: FloatArray
    shape: FloatArray
    full: float
    least: float


@dataclass(frozen=True, eq=False, repr=False)
class HybridModel(NonlinearModel):
    """A `NonlinearModel` whose states are those of its linear model; make it with `hybrid_model`.

    x[k+1] = A x[k] + B0 u[k - delay] + B1 u[k - delay - 1] + size gate(z) network(z), z being the features of x[k] and
    u[k - delay]. Where the gate is 0 a step is that of the linear model.

    Attributes
    ----------
    linear
        The linear model.
    correction
        The network and where it counts.
    """

    linear: DiscreteModel = field(kw_only=True)
    correction: Correction = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of its kind for tables and files."""
        return "hybrid"


def hybrid_model(
    name: str, linear: DiscreteModel, correction: Correction, provenance: Mapping[str, object] | None = None
) -> HybridModel:
    """The velocity model of a linear model and a network.

    Raises
    ------
    ModelError
        If shapes do not agree, or as `NonlinearModel`.
    """
    n, memory, c = linear.order, linear.memory, correction
    units = c.outward.shape[0]
    shapes = {"scale": (n + 2,), "inward": (n + 2, units), "outward": (units, n), "shape": (n + 2, n + 2)}
    for role, expected in shapes.items():
        found = getattr(c, role).shape
        if found != expected:
            raise ModelError(f"model '{name}': {role} has shape {found}, expected {expected}; train it again")
    x, window = ca.SX.sym("x", n), ca.SX.sym("window", 2 * (memory + 1))
    recent, older = (
        ca.vertcat(*(window[2 * (memory - int(linear.delay[row]) - late) + row] for row in (0, 1))) for late in (0, 1)
    )
    z = ca.vertcat(x, recent) / ca.DM(c.scale)
    says = network(ca, z, ca.DM(c.inward), ca.DM(c.outward)) * gate(ca, z, ca.DM(c.shape), c.full, c.least)
    after = ca.DM(linear.A) @ x + ca.DM(linear.B0) @ recent + ca.DM(linear.B1) @ older + ca.DM(c.scale[:n]) * says
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    output = ca.Function("output", [x], [ca.DM(linear.C) @ x], ["x"], ["y"])
    return HybridModel(
        name,
        step,
        output,
        linear.dt,
        memory,
        linear=linear,
        correction=correction,
        provenance=dict(provenance or {}),
    )
