"""Model-predictive trajectory tracking with identified velocity models: the public names.

They are imported on first use, so that a robot needs neither MuJoCo nor matplotlib, and unused modules cost no time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.bench.drive import simulate as simulate
    from diffdrive_mpc.bench.sweep import sweep as sweep
    from diffdrive_mpc.models.checked_yaml import ConfigError as ConfigError
    from diffdrive_mpc.models.compiled.compiler import NotCompiledError as NotCompiledError
    from diffdrive_mpc.models.errors import ArgumentError as ArgumentError
    from diffdrive_mpc.models.errors import DiffdriveMpcError as DiffdriveMpcError
    from diffdrive_mpc.models.errors import MissingPackageError as MissingPackageError
    from diffdrive_mpc.models.identification.from_logs import identify as identify
    from diffdrive_mpc.models.interface import Measurement as Measurement
    from diffdrive_mpc.models.interface import Stamped as Stamped
    from diffdrive_mpc.models.load import load_model as load_model
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel as NonlinearModel
    from diffdrive_mpc.models.pose import integrate_pose as integrate_pose
    from diffdrive_mpc.models.velocity_model import ModelError as ModelError
    from diffdrive_mpc.models.velocity_model import VelocityModel as VelocityModel
    from diffdrive_mpc.mpc.casadi_problem import casadi_problem as casadi_problem
    from diffdrive_mpc.mpc.config.config_file import load_config as load_config
    from diffdrive_mpc.mpc.config.schema import ControllerConfig as ControllerConfig
    from diffdrive_mpc.mpc.controller import Controller as Controller
    from diffdrive_mpc.mpc.problem.terms import Term as Term
    from diffdrive_mpc.mpc.trajectories.load import load_trajectory as load_trajectory
    from diffdrive_mpc.mpc.trajectories.trajectory import Trajectory as Trajectory
    from diffdrive_mpc.sim.plants.make import make_plant as make_plant
    from diffdrive_mpc.sim.plants.plant import RobotLostError as RobotLostError

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
    "casadi_problem": "mpc.casadi_problem",
    "identify": "models.identification.from_logs",
    "integrate_pose": "models.pose",
    "load_config": "mpc.config.config_file",
    "load_model": "models.load",
    "load_trajectory": "mpc.trajectories.load",
    "make_plant": "sim.plants.make",
    "simulate": "bench.drive",
    "sweep": "bench.sweep",
}

if not TYPE_CHECKING:  # a type checker uses the imports above as the public names
    __all__ = list(_HOMES)
__getattr__, __dir__ = on_first_use(__name__, _HOMES)
