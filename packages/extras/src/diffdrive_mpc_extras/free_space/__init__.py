"""Free space: surroundings, outline of the robot, paths around obstacles, and the check of the stopping path."""

from diffdrive_mpc_extras.free_space.polygons import Footprint
from diffdrive_mpc_extras.free_space.surroundings import (
    Corridor,
    MovingDisc,
    OccupancyGrid,
    Surroundings,
    SurroundingsError,
)

__all__ = ["Corridor", "Footprint", "MovingDisc", "OccupancyGrid", "Surroundings", "SurroundingsError"]
