"""Robot models: velocity models, kinematics of wheels and pose, and identification from logs.

Names are imported on first use, so that loading a model does not import the log readers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.models.discrete_model import DiscreteModel as DiscreteModel
    from diffdrive_mpc.models.identification.from_logs import Identification as Identification
    from diffdrive_mpc.models.identification.from_logs import identify as identify
    from diffdrive_mpc.models.interface import Measurement as Measurement
    from diffdrive_mpc.models.interface import Reference as Reference
    from diffdrive_mpc.models.interface import ReferenceSample as ReferenceSample
    from diffdrive_mpc.models.interface import Stamped as Stamped
    from diffdrive_mpc.models.load import load_model as load_model
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel as NonlinearModel
    from diffdrive_mpc.models.pose import integrate_pose as integrate_pose
    from diffdrive_mpc.models.velocity_model import ModelError as ModelError
    from diffdrive_mpc.models.velocity_model import VelocityModel as VelocityModel
    from diffdrive_mpc.models.wheels import WheelKinematics as WheelKinematics

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

if not TYPE_CHECKING:  # a type checker takes the imports above for the public names
    __all__ = list(_HOMES)
__getattr__, __dir__ = on_first_use(__name__, _HOMES)
