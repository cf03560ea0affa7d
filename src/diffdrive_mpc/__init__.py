"""Model-predictive trajectory tracking with identified velocity models: the public names.

They are imported on first use, so that a robot needs neither MuJoCo nor matplotlib, and nobody waits for what is not
asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.from_logs import identify
    from diffdrive_mpc.models.interface import Measurement, Stamped
    from diffdrive_mpc.models.load import load_model
    from diffdrive_mpc.models.pose import integrate_pose
    from diffdrive_mpc.mpc.config.config_file import load_config
    from diffdrive_mpc.mpc.config.schema import ControllerConfig
    from diffdrive_mpc.mpc.controller import Controller
    from diffdrive_mpc.mpc.trajectories.load import load_trajectory
    from diffdrive_mpc.sim.loop import simulate
    from diffdrive_mpc.sim.make import make_plant

_HOMES = {
    "Controller": "mpc.controller",
    "ControllerConfig": "mpc.config.schema",
    "Measurement": "models.interface",
    "Stamped": "models.interface",
    "identify": "models.identification.from_logs",
    "integrate_pose": "models.pose",
    "load_config": "mpc.config.config_file",
    "load_model": "models.load",
    "load_trajectory": "mpc.trajectories.load",
    "make_plant": "sim.make",
    "simulate": "sim.loop",
}

__all__ = [
    "Controller",
    "ControllerConfig",
    "Measurement",
    "Stamped",
    "identify",
    "integrate_pose",
    "load_config",
    "load_model",
    "load_trajectory",
    "make_plant",
    "simulate",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type checker sees the imports above
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
