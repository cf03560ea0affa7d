"""What a floor asks of the motors of a skid-steer in a turn: shear under the tyres, torque per side, least radius."""

from diffdrive_mpc.models.terrain.fitting import FittedShear, fit_shear
from diffdrive_mpc.models.terrain.least_radius import LIMIT_SHARE, least_radius
from diffdrive_mpc.models.terrain.terrain_file import Shear, Terrain, load_terrain
from diffdrive_mpc.models.terrain.turning import SideTorques, side_torques
from diffdrive_mpc.models.terrain.vehicle import Vehicle, load_vehicle

__all__ = [
    "LIMIT_SHARE",
    "FittedShear",
    "Shear",
    "SideTorques",
    "Terrain",
    "Vehicle",
    "fit_shear",
    "least_radius",
    "load_terrain",
    "load_vehicle",
    "side_torques",
]
