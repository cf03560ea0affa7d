"""Hybrid velocity model: a linear model with a small network for its residuals."""

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
from diffdrive_mpc.models.structures.identified import round_values
from diffdrive_mpc.models.structures.model_file import Finite, FunctionFile, SmFile, build_model, write_parameters
from diffdrive_mpc.models.velocity_model import ModelError


def network(m: Any, z: Any, inward: Any, outward: Any) -> Any:  # noqa: ANN401 - arrays and symbols of any library
    """Evaluate a layer of tanh units and a linear output layer, (n,), both without offsets.

    The function is odd, so it is zero at rest and symmetric in direction. `m` is the array library (CasADi or JAX), z
    (f,) are the features, inward (f, units) and outward (units, n) the weights.
    """
    return outward.T @ m.tanh(inward.T @ z)


def gate(m: Any, z: Any, shape: Any, full: float, least: float) -> Any:  # noqa: ANN401
    """Compute the gate: 1 if the squared distance z' shape z is at most `full`, 0 if it is at least `least`.

    The distance is the Mahalanobis distance from rest; `shape` (f, f) is the inverse covariance of the features in the
    training data. The derivative of the gate is continuous.
    """
    fraction = (z.T @ shape @ z - full) / (least - full)
    clipped = m.fmin(m.fmax(fraction, 0.0), 1.0)
    return 1.0 - clipped**2 * (3.0 - 2.0 * clipped)


@dataclass(frozen=True, eq=False)
class Correction:
    """Network on n states and two commands, with its gate.

    Attributes
    ----------
    scale
        (n + 2,) RMS of the states, v_ref [m/s] and omega_ref [rad/s]; features are these values divided by `scale`.
    inward, outward
        (n + 2, units), (units, n) weights; the output, multiplied by `scale`, is added to the states.
    shape
        (n + 2, n + 2) inverse covariance of the features in the training data.
    full, least
        Squared Mahalanobis distances from rest: the gate is 1 up to `full` and 0 from `least` [-].
    """

    scale: FloatArray
    inward: FloatArray
    outward: FloatArray
    shape: FloatArray
    full: float
    least: float


@dataclass(frozen=True, eq=False, repr=False)
class HybridModel(NonlinearModel):
    """`NonlinearModel` with the states of its linear model; build it with `hybrid_model`.

    x[k+1] = A x[k] + B0 u[k - delay] + B1 u[k - delay - 1] + scale gate(z) network(z); z are the features of x[k] and
    u[k - delay]. If the gate is 0, the step is that of the linear model.

    Attributes
    ----------
    linear
        Linear model.
    correction
        Network and gate.
    """

    linear: DiscreteModel = field(kw_only=True)
    correction: Correction = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of the structure in tables and files."""
        return "hybrid"


def hybrid_model(
    name: str, linear: DiscreteModel, correction: Correction, provenance: Mapping[str, object] | None = None
) -> HybridModel:
    """Build the velocity model from a linear model and a correction.

    Raises
    ------
    ModelError
        If the shapes do not match, or `NonlinearModel` raises it.
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
        ca.vertcat(*(window[2 * (memory - int(linear.delay[row]) - age) + row] for row in (0, 1))) for age in (0, 1)
    )
    z = ca.vertcat(x, recent) / ca.DM(c.scale)
    change = network(ca, z, ca.DM(c.inward), ca.DM(c.outward)) * gate(ca, z, ca.DM(c.shape), c.full, c.least)
    next_x = ca.DM(linear.A) @ x + ca.DM(linear.B0) @ recent + ca.DM(linear.B1) @ older + ca.DM(c.scale[:n]) * change
    step = ca.Function("step", [x, window], [next_x], ["x", "window"], ["after"])
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


_HEAD = (
    "A linear model and a network for its residuals. Features: states, v_ref [m/s] and omega_ref [rad/s] over scale."
)
_Row = Annotated[list[Finite], Field(max_length=file_limits().units)]
Rows = Annotated[list[_Row], Field(min_length=1, max_length=file_limits().units)]


class CorrectionContent(StrictModel):
    """Network and gate in a parameter file; see `hybrid_model.Correction`."""

    scale: list[Positive] = Field(description="RMS of each state, of v_ref [m/s] and of omega_ref [rad/s]")
    inward: Rows = Field(description="weights from features to units [-]")
    outward: Rows = Field(description="weights from units to states [-]")
    shape: Rows = Field(description="inverse covariance of the features in the training data [-]")
    full: Positive = Field(description="maximum squared distance at which the gate is 1 [-]")
    least: Positive = Field(description="minimum squared distance at which the gate is 0 [-]")

    @model_validator(mode="after")
    def _check_consistency(self) -> CorrectionContent:
        if not self.least > self.full:
            raise ValueError(f"least {self.least} must be greater than full {self.full}; train it again")
        for name in ("inward", "outward", "shape"):
            if len({len(row) for row in getattr(self, name)}) > 1:
                raise ValueError(f"{name} has rows of different lengths; train it again")
        return self

    @property
    def arrays(self) -> Correction:
        """Correction with arrays."""
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


def load_hybrid(path: Path, data: Any) -> HybridModel:  # noqa: ANN401 - content of a YAML file
    """Load the model of the parameter file at `path` with the content `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the content is invalid.
    models.velocity_model.ModelError
        If the model is not plausible for a robot.
    """
    return model_from_file(check(HybridFile, data, str(path)))


def model_from_file(content: HybridFile) -> HybridModel:
    """Build the model of a parameter file; raise ModelError if the model is not plausible for a robot."""
    linear = build_model(content.linear).discretise(content.sample_time)
    return hybrid_model(content.name, linear, content.correction.arrays, content.origins)


def correction_content(correction: Correction) -> dict[str, Any]:
    """Convert a correction to the content of a file, with rounded values."""
    return {name: round_values(getattr(correction, name)) for name in CorrectionContent.model_fields}


def write_hybrid(path: Path, content: HybridFile) -> None:
    """Write a parameter file; raise OSError if the file cannot be written."""
    write_parameters(path, _HEAD, content)
