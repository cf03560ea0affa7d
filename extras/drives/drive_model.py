"""A drive model as the velocity model of controller and plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np

from diffdrive_mpc.extras.drives.equations import STATES, Channel, experimental_step, physical_step
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel

Kind = Literal["drive_experimental", "drive_physical"]
STEPS = {"drive_experimental": experimental_step, "drive_physical": physical_step}
"""One channel of each."""


@dataclass(frozen=True, eq=False, repr=False)
class DriveModel(NonlinearModel):
    """A `NonlinearModel` with a sharp twin; make it with `drive_model`.

    Attributes
    ----------
    kind
        Which of the paper's two models.
    sharp
        `step` without what rounds it off.
    """

    kind: Kind = field(kw_only=True)
    sharp: ca.Function = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of its kind for tables and files."""
        return self.kind

    @property
    def plant_step(self) -> ca.Function:
        """A robot has no reason to be differentiable."""
        return self.sharp


def drive_model(
    name: str,
    kind: Kind,
    dt: float,
    dead_samples: Sequence[int],
    still: Sequence[float],
    coefficients: Sequence[FloatArray],
    provenance: Mapping[str, object] | None = None,
) -> DriveModel:
    """The velocity model of two channels.

    Parameters
    ----------
    dt
        Sample time [s].
    dead_samples, still, coefficients
        For v and omega: dead time in samples, and what `Channel` and the step of the kind say.

    Raises
    ------
    ModelError
        As `NonlinearModel`.
    """
    memory = max(1, *dead_samples)
    x, window = ca.SX.sym("x", 2 * STATES), ca.SX.sym("window", 2 * (memory + 1))
    steps = []
    for sharp in (False, True):
        after = [
            STEPS[kind](Channel(dt, still[row]), sharp=sharp)(
                x[STATES * row : STATES * (row + 1)], window[2 * (memory - dead_samples[row]) + row], coefficients[row]
            )
            for row in (0, 1)
        ]
        steps.append(ca.Function("step", [x, window], [ca.vertcat(*after)], ["x", "window"], ["after"]))
    output = ca.Function("output", [x], [x[[1, STATES + 1]]], ["x"], ["y"])
    return DriveModel(name, steps[0], output, dt, memory, kind=kind, sharp=steps[1], provenance=dict(provenance or {}))


def settled_state(kind: Kind, speed: float, coefficients: FloatArray) -> FloatArray:
    """(4,) state of a channel that has been going at `speed` for long."""
    reference = speed / coefficients[0]
    if kind == "drive_experimental":
        return np.array([reference, speed, 0.0, np.sign(speed)])
    response = coefficients[3:].reshape(4, 3).T
    rest = np.linalg.lstsq(
        (np.eye(3) - response[:, :3])[:, 1:], (response[:, 3] - np.eye(3)[:, 0] + response[:, 0]) * speed, rcond=None
    )[0]
    return np.array([reference, speed, *rest])
