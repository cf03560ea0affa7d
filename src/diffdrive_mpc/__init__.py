"""Model-predictive trajectory tracking with identified velocity models: the public names.

They are imported on first use, so that a robot needs neither MuJoCo nor matplotlib, and nobody waits for what is not
asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.bench.drive import simulate
    from diffdrive_mpc.bench.sweep import sweep
    from diffdrive_mpc.models.checked_yaml import ConfigError
    from diffdrive_mpc.models.compiled.compiler import NotCompiledError
    from diffdrive_mpc.models.errors import ArgumentError, DiffdriveMpcError, MissingPackageError
    from diffdrive_mpc.models.identification.from_logs import identify
    from diffdrive_mpc.models.interface import Measurement, Stamped
    from diffdrive_mpc.models.load import load_model
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel
    from diffdrive_mpc.models.pose import integrate_pose
    from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel
    from diffdrive_mpc.mpc.config.config_file import load_config
    from diffdrive_mpc.mpc.config.schema import ControllerConfig
    from diffdrive_mpc.mpc.controller import Controller
    from diffdrive_mpc.mpc.problem.terms import Term
    from diffdrive_mpc.mpc.trajectories.load import load_trajectory
    from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory
    from diffdrive_mpc.sim.plants.make import make_plant
    from diffdrive_mpc.sim.plants.plant import RobotLostError

_HOMES = {
    "ArgumentError": "models.errors",
    "ConfigError": "models.checked_yaml",
    "Controller": "mpc.controller",
    "ControllerConfig": "mpc.config.schema",
    "DiffdriveMpcError": "models.errors",
    "Measurement": "models.interface",
    "MissingPackageError": "models.errors",
    "ModelError": "models.velocity_model",
    "NonlinearModel": "models.nonlinear_model",
    "NotCompiledError": "models.compiled.compiler",
    "RobotLostError": "sim.plants.plant",
    "Stamped": "models.interface",
    "Term": "mpc.problem.terms",
    "Trajectory": "mpc.trajectories.trajectory",
    "VelocityModel": "models.velocity_model",
    "identify": "models.identification.from_logs",
    "integrate_pose": "models.pose",
    "load_config": "mpc.config.config_file",
    "load_model": "models.load",
    "load_trajectory": "mpc.trajectories.load",
    "make_plant": "sim.plants.make",
    "simulate": "bench.drive",
    "sweep": "bench.sweep",
}

__all__ = [
    "ArgumentError",
    "ConfigError",
    "Controller",
    "ControllerConfig",
    "DiffdriveMpcError",
    "Measurement",
    "MissingPackageError",
    "ModelError",
    "NonlinearModel",
    "NotCompiledError",
    "RobotLostError",
    "Stamped",
    "Term",
    "Trajectory",
    "VelocityModel",
    "identify",
    "integrate_pose",
    "load_config",
    "load_model",
    "load_trajectory",
    "make_plant",
    "simulate",
    "sweep",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type checker sees the imports above
    """Import a public name when it is first asked for."""
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
