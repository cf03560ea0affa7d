"""What the robot is: identified velocity models, wheel, body and pose kinematics, identification from logs."""

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import Measurement, Reference, ReferenceSample, Stamped
from diffdrive_mpc.models.load import load_model
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel
from diffdrive_mpc.models.wheels import WheelKinematics

__all__ = [
    "DiscreteModel",
    "Measurement",
    "ModelError",
    "Reference",
    "ReferenceSample",
    "Stamped",
    "VelocityModel",
    "WheelKinematics",
    "integrate_pose",
    "load_model",
]
