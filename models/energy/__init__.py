"""What driving costs: electrical power from torques and speeds, its constants, energy before a drive is driven."""

from diffdrive_mpc.models.energy.drive_constants import DriveConstants, NamedDrive, load_drive_constants
from diffdrive_mpc.models.energy.identification import IdentifiedConstants, identify_constants, logged_energy
from diffdrive_mpc.models.energy.prediction import PredictedEnergy, predict_energy

__all__ = [
    "DriveConstants",
    "IdentifiedConstants",
    "NamedDrive",
    "PredictedEnergy",
    "identify_constants",
    "load_drive_constants",
    "logged_energy",
    "predict_energy",
]
