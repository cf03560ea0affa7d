"""What a floor asks of the motors of a skid-steer in a turn: shear under the tyres, torque per side, least radius."""

from diffdrive_mpc.extras.terrain.fitting import FittedShear, fit_shear
from diffdrive_mpc.extras.terrain.terrain_file import Shear, Terrain, load_terrain
from diffdrive_mpc.extras.terrain.turning import SideTorques, side_torques

__all__ = [
    "FittedShear",
    "Shear",
    "SideTorques",
    "Terrain",
    "fit_shear",
    "load_terrain",
    "side_torques",
]
