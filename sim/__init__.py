"""What stands in for the robot: plants, sensors, the closed loop and its metrics.

Everything is imported on first use, so that it works where MuJoCo is not installed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.sim.loop import simulate
    from diffdrive_mpc.sim.metrics.metrics import Metrics
    from diffdrive_mpc.sim.plants.make import make_plant
    from diffdrive_mpc.sim.plants.plant import Plant
    from diffdrive_mpc.sim.run import Run

_HOMES = {
    "Metrics": "diffdrive_mpc.sim.metrics.metrics",
    "Plant": "diffdrive_mpc.sim.plants.plant",
    "Run": "diffdrive_mpc.sim.run",
    "make_plant": "diffdrive_mpc.sim.plants.make",
    "simulate": "diffdrive_mpc.sim.loop",
}

__all__ = ["Metrics", "Plant", "Run", "make_plant", "simulate"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type checker sees the imports above
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
