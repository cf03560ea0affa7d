"""Simulation of the robot: plants, sensors, closed loop and metrics.

Names are imported on first use, so that the package can be imported without MuJoCo.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.sim.loop import simulate as simulate
    from diffdrive_mpc.sim.metrics.metrics import Metrics as Metrics
    from diffdrive_mpc.sim.plants.make import make_plant as make_plant
    from diffdrive_mpc.sim.plants.plant import Plant as Plant
    from diffdrive_mpc.sim.run import Run as Run

_MODULES = {
    "Metrics": "metrics.metrics",
    "Plant": "plants.plant",
    "Run": "run",
    "make_plant": "plants.make",
    "simulate": "loop",
}

if not TYPE_CHECKING:  # a type checker uses the imports above as the public names
    __all__ = list(_MODULES)
__getattr__, __dir__ = on_first_use(__name__, _MODULES)
