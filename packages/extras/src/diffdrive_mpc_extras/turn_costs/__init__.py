"""Turn costs of a robot on a surface: slip law, torques, power and least radius in one file."""

from diffdrive_mpc_extras.turn_costs.slip import IdentifiedSlip, identify_slip
from diffdrive_mpc_extras.turn_costs.turn_costs import (
    LIMIT_SHARE,
    SlipCoefficients,
    TorqueTable,
    TurnCosts,
    least_radius,
    load_turn_costs,
    turn_costs_text,
)
from diffdrive_mpc_extras.turn_costs.vehicle import (
    DriveConstants,
    NamedDrive,
    Vehicle,
    load_drive_constants,
    load_vehicle,
)

__all__ = [
    "LIMIT_SHARE",
    "DriveConstants",
    "IdentifiedSlip",
    "NamedDrive",
    "SlipCoefficients",
    "TorqueTable",
    "TurnCosts",
    "Vehicle",
    "identify_slip",
    "least_radius",
    "load_drive_constants",
    "load_turn_costs",
    "load_vehicle",
    "turn_costs_text",
]
