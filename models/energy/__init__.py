"""What driving costs: electrical power from torques and speeds, its constants, energy before a drive is driven."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.energy.drive_constants import DriveConstants, NamedDrive, load_drive_constants
from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
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
_IDENTIFIED = ("IdentifiedConstants", "identify_constants", "logged_energy")
_PREDICTED = ("PredictedEnergy", "predict_energy")
__getattr__ = on_first_use(
    __name__, dict.fromkeys(_IDENTIFIED, "identification") | dict.fromkeys(_PREDICTED, "prediction")
)
