"""What a floor asks of the motors of a skid-steer in a turn: shear under the tyres, torque per side, least radius."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.terrain.fitting import FittedShear, fit_shear
    from diffdrive_mpc_extras.terrain.terrain_file import Shear, Terrain, load_terrain
    from diffdrive_mpc_extras.terrain.turning import SideTorques, side_torques

__all__ = [
    "FittedShear",
    "Shear",
    "SideTorques",
    "Terrain",
    "fit_shear",
    "load_terrain",
    "side_torques",
]
__getattr__ = on_first_use(
    __name__,
    {
        "FittedShear": "fitting",
        "fit_shear": "fitting",
        "Shear": "terrain_file",
        "Terrain": "terrain_file",
        "load_terrain": "terrain_file",
        "SideTorques": "turning",
        "side_torques": "turning",
    },
)
