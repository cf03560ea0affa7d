"""What the robot is: identified velocity models, wheel, body and pose kinematics, identification from logs."""

from models.discrete_model import DiscreteModel
from models.interface import Measurement, Reference, ReferenceSample, Stamped
from models.load import load_model
from models.pose import integrate_pose
from models.velocity_model import ModelError, VelocityModel
from models.wheels import WheelKinematics

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
