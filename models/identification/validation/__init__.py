"""How good a model is on records that it was not identified from."""

from diffdrive_mpc.models.identification.validation.pose_drift import PoseDrift, pose_drift
from diffdrive_mpc.models.identification.validation.residuals import ResidualCheck, check_residuals
from diffdrive_mpc.models.identification.validation.simulation import Validation, score, simulate_records, validate

__all__ = [
    "PoseDrift",
    "ResidualCheck",
    "Validation",
    "check_residuals",
    "pose_drift",
    "score",
    "simulate_records",
    "validate",
]
