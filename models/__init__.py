"""What the robot is: identified velocity models, wheel, body and pose kinematics, identification from logs.

Names are imported on first use, so that loading a model does not import the log readers.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.models.discrete_model import DiscreteModel
    from diffdrive_mpc.models.identification.from_logs import Identification, identify
    from diffdrive_mpc.models.interface import Measurement, Reference, ReferenceSample, Stamped
    from diffdrive_mpc.models.load import load_model
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel
    from diffdrive_mpc.models.pose import integrate_pose
    from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel
    from diffdrive_mpc.models.wheels import WheelKinematics

_HOMES = {
    "DiscreteModel": "discrete_model",
    "Identification": "identification.from_logs",
    "Measurement": "interface",
    "ModelError": "velocity_model",
    "NonlinearModel": "nonlinear_model",
    "Reference": "interface",
    "ReferenceSample": "interface",
    "Stamped": "interface",
    "VelocityModel": "velocity_model",
    "WheelKinematics": "wheels",
    "identify": "identification.from_logs",
    "integrate_pose": "pose",
    "load_model": "load",
}

__all__ = [
    "DiscreteModel",
    "Identification",
    "Measurement",
    "ModelError",
    "NonlinearModel",
    "Reference",
    "ReferenceSample",
    "Stamped",
    "VelocityModel",
    "WheelKinematics",
    "identify",
    "integrate_pose",
    "load_model",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type checker sees the imports above
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
