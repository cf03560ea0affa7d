"""Where the robot may drive: what lies around it, its outline, a way round things, and the check of its way to rest."""

from diffdrive_mpc_extras.free_space.polygons import Footprint
from diffdrive_mpc_extras.free_space.surroundings import (
    Corridor,
    MovingDisc,
    OccupancyGrid,
    Surroundings,
    SurroundingsError,
)

__all__ = ["Corridor", "Footprint", "MovingDisc", "OccupancyGrid", "Surroundings", "SurroundingsError"]
