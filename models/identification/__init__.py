"""From records of a robot to the numbers of a velocity model."""

from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.fit import fit_percent, pooled_fit_percent
from diffdrive_mpc.models.identification.identified import IdentifiedModel
from diffdrive_mpc.models.identification.mbm import identify_mbm
from diffdrive_mpc.models.identification.model_file import model_file, write_model_file
from diffdrive_mpc.models.identification.order import OrderChoice, OrderRow, choose_order
from diffdrive_mpc.models.identification.pose_calibration import PoseCalibration, calibrate_gyro, calibrate_wheels
from diffdrive_mpc.models.identification.slip_laws import ConstantTrack, SlipPolynomial, VirtualTrack
from diffdrive_mpc.models.identification.sm import identify_sm
from diffdrive_mpc.models.identification.ssm import identify_ssm, identify_ssm_orders
from diffdrive_mpc.models.identification.tracks import identify_track, side_difference

__all__ = [
    "ConstantTrack",
    "Estimate",
    "IdentifiedModel",
    "OrderChoice",
    "OrderRow",
    "PoseCalibration",
    "SlipPolynomial",
    "VirtualTrack",
    "calibrate_gyro",
    "calibrate_wheels",
    "choose_order",
    "fit_percent",
    "identify_mbm",
    "identify_sm",
    "identify_ssm",
    "identify_ssm_orders",
    "identify_track",
    "model_file",
    "pooled_fit_percent",
    "side_difference",
    "write_model_file",
]
