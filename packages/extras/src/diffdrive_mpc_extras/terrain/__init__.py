"""What a floor asks of the motors of a skid-steer in a turn: shear under the tyres, torque per side, least radius."""

from diffdrive_mpc_extras.terrain.terrain_file import Shear, Terrain, load_terrain
from diffdrive_mpc_extras.terrain.turning import SideTorques, side_torques

__all__ = ["Shear", "SideTorques", "Terrain", "load_terrain", "side_torques"]
