"""What driving costs: motor constants from a log, and energy before a drive is driven."""

from diffdrive_mpc_extras.energy.identification import IdentifiedConstants, identify_constants, logged_energy
from diffdrive_mpc_extras.torque.torque_curves import PredictedEnergy, predict_energy

__all__ = ["IdentifiedConstants", "PredictedEnergy", "identify_constants", "logged_energy", "predict_energy"]
