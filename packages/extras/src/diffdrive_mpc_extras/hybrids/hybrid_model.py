"""A linear model with a small network for its residuals, as the velocity model of controller and plants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.identified import rounded
from diffdrive_mpc.models.structures.model_file import Finite, FunctionFile, SmFile, build_model, write_parameters
from diffdrive_mpc.models.velocity_model import ModelError

# Output of the network of a hybrid, and its weight, for any library: CasADi or JAX.


def network(m: Any, z: Any, inward: Any, outward: Any) -> Any:  # noqa: ANN401 - arrays and symbols of any library
    """Evaluate one layer (n,) of tanh without offsets: it is odd, so it is zero at rest, and symmetric in direction.

    z (f,) features, inward (f, units), outward (units, n).
    """
    return outward.T @ m.tanh(inward.T @ z)


def gate(m: Any, z: Any, shape: Any, full: float, least: float) -> Any:  # noqa: ANN401
    """Compute the gate: 1 if the squared distance z' shape z is at most `full`, exactly 0 from `least` on.

    `shape` (f, f) is the inverse covariance of the features of the data, so that this is Mahalanobis' distance from
    rest. Its slope is continuous.
    """
    past = (z.T @ shape @ z - full) / (least - full)
    share = m.fmin(m.fmax(past, 0.0), 1.0)
    return 1.0 - share**2 * (3.0 - 2.0 * share)


@dataclass(frozen=True, eq=False)
class Correction:
    """A network on n states and two commands, and its weight.

    Attributes
    ----------
    scale
        (n + 2,) usual size of the states and of v_ref [m/s], omega_ref [rad/s]; features are these over their size.
    inward, outward
        (n + 2, units), (units, n) weights; its output is added to the states in units of their size.
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
        The network and its weight.
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
    """Build the velocity model of a linear model and a network.

    Raises
    ------
    ModelError
        If shapes do not agree, or as `NonlinearModel`.
    """
    n, memory, c = linear.order, linear.memory, correction
    units = c.outward.shape[0]
    shapes = {"scale": (n + 2,), "inward": (n + 2, units), "outward": (units, n), "shape": (n + 2, n + 2)}
    for role, expected in shapes.items():
        shape = getattr(c, role).shape
        if shape != expected:
            raise ModelError(f"model '{name}': {role} has shape {shape}, expected {expected}; train it again")
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


# Parameter files of hybrids: the whole file of the linear model within, and the few weights of the network.


_HEAD = (
    "A linear model and a network on what it leaves. Features: states, v_ref [m/s] and omega_ref [rad/s] over scale."
)
_Row = Annotated[list[Finite], Field(max_length=file_limits().units)]
Rows = Annotated[list[_Row], Field(min_length=1, max_length=file_limits().units)]


class CorrectionContent(StrictModel):
    """The network, and its weight; see `hybrid_model.Correction`."""

    scale: list[Positive] = Field(description="usual size of each state, of v_ref and of omega_ref")
    inward: Rows = Field(description="weights from features to units [-]")
    outward: Rows = Field(description="weights from units to states [-]")
    shape: Rows = Field(description="inverse covariance of the features in the data [-]")
    full: Positive = Field(description="squared distance up to which the network counts in full [-]")
    least: Positive = Field(description="squared distance from which on it does not count [-]")

    @model_validator(mode="after")
    def _ordered(self) -> CorrectionContent:
        if not self.least > self.full:
            raise ValueError(f"least {self.least} must be greater than full {self.full}; train it again")
        for name in ("inward", "outward", "shape"):
            if len({len(row) for row in getattr(self, name)}) > 1:
                raise ValueError(f"{name} has rows of different length; train it again")
        return self

    @property
    def arrays(self) -> Correction:
        """The same as arrays."""
        return Correction(
            np.array(self.scale),
            np.array(self.inward),
            np.array(self.outward),
            np.array(self.shape),
            self.full,
            self.least,
        )


class HybridFile(FunctionFile):
    """Content of the parameter file of a hybrid."""

    structure: Literal["hybrid"]
    linear: SmFile
    correction: CorrectionContent


def load_hybrid(path: Path, data: Any) -> HybridModel:  # noqa: ANN401 - what a YAML file may hold
    """Load the model of the parameter file at `path` with the content `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has a mistake.
    models.velocity_model.ModelError
        If it cannot be a robot's.
    """
    return hybrid_of(check(HybridFile, data, str(path)))


def hybrid_of(content: HybridFile) -> HybridModel:
    """Build the model of a parameter file; raise ModelError if it cannot be a robot's."""
    linear = build_model(content.linear).discretise(content.sample_time)
    return hybrid_model(content.name, linear, content.correction.arrays, content.origins)


def correction_content(correction: Correction) -> dict[str, Any]:
    """Convert a correction to its content in a file."""
    return {name: rounded(getattr(correction, name)) for name in CorrectionContent.model_fields}


def write_hybrid(path: Path, content: HybridFile) -> None:
    """Write a parameter file; raises OSError where that cannot be done."""
    write_parameters(path, _HEAD, content)
