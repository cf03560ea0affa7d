"""What one robot on one floor does and pays in a turn: slip law, torque curves, power, least radius, in one file."""

from diffdrive_mpc.models.turn_costs.slip import IdentifiedSlip, identify_slip, identify_slip_from_poses
from diffdrive_mpc.models.turn_costs.turn_costs import (
    SlipCoefficients,
    TorqueTable,
    TurnCosts,
    load_turn_costs,
    turn_costs_text,
)

__all__ = [
    "IdentifiedSlip",
    "SlipCoefficients",
    "TorqueTable",
    "TurnCosts",
    "identify_slip",
    "identify_slip_from_poses",
    "load_turn_costs",
    "turn_costs_text",
]
