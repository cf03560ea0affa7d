"""Terrain: shear under the tyres of a skid-steer robot in a turn, and the torque of each side."""

from diffdrive_mpc_extras.terrain.terrain_file import Shear, Terrain, load_terrain
from diffdrive_mpc_extras.terrain.turning import SideTorques, side_torques

__all__ = ["Shear", "SideTorques", "Terrain", "load_terrain", "side_torques"]
