"""What one robot on one floor does and pays in a turn: slip law, torques, power, least radius, in one file."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

# A module of the same name stands beside this: looked up later, it would be found in place of the function.
from diffdrive_mpc_extras.turn_costs.turn_costs import LIMIT_SHARE, least_radius

if TYPE_CHECKING:
    from diffdrive_mpc_extras.turn_costs.slip import IdentifiedSlip, identify_slip, identify_slip_from_poses
    from diffdrive_mpc_extras.turn_costs.turn_costs import (
        SlipCoefficients,
        TorqueTable,
        TurnCosts,
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
    "identify_slip_from_poses",
    "least_radius",
    "load_drive_constants",
    "load_turn_costs",
    "load_vehicle",
    "turn_costs_text",
]
_SLIP = ("IdentifiedSlip", "identify_slip", "identify_slip_from_poses")
_COSTS = ("SlipCoefficients", "TorqueTable", "TurnCosts", "load_turn_costs", "turn_costs_text")
_VEHICLE = ("DriveConstants", "NamedDrive", "Vehicle", "load_drive_constants", "load_vehicle")
_HOMES = {
    "slip": _SLIP,
    "turn_costs": _COSTS,
    "vehicle": _VEHICLE,
}
__getattr__ = on_first_use(__name__, {name: home for home, names in _HOMES.items() for name in names})
