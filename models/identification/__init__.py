"""From records of a robot to the numbers of a velocity model."""

from diffdrive_mpc.models.identification.geometry import identify_track, side_difference
from diffdrive_mpc.models.identification.pose_calibration import PoseCalibration, calibrate_gyro, calibrate_wheels
from diffdrive_mpc.models.identification.slip_laws import ConstantTrack, SlipPolynomial, VirtualTrack
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.validation import fit_percent, pooled_fit_percent
from diffdrive_mpc.models.structures.identified import IdentifiedModel, model_file, write_model_file
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.orders import OrderChoice, OrderRow
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.ssm import choose_order, identify_ssm, identify_ssm_orders

__all__ = [
    "ConstantTrack",
    "IdentifiedModel",
    "OrderChoice",
    "OrderRow",
    "ParameterEstimate",
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
