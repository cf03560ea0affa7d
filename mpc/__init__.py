"""Controller: reference trajectories, tracking problem, solver, estimator and failure ladder.

Public names are imported on first access, so that the import of a submodule does not load the controller.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.models.interface import Measurement as Measurement
    from diffdrive_mpc.models.interface import Stamped as Stamped
    from diffdrive_mpc.mpc.config.config_file import load_config as load_config
    from diffdrive_mpc.mpc.config.schema import ControllerConfig as ControllerConfig
    from diffdrive_mpc.mpc.controller import Controller as Controller
    from diffdrive_mpc.mpc.estimate import Estimate as Estimate
    from diffdrive_mpc.mpc.hold import Hold as Hold
    from diffdrive_mpc.mpc.problem.terms import Term as Term
    from diffdrive_mpc.mpc.solver.report import SolverMethod as SolverMethod
    from diffdrive_mpc.mpc.solver.report import SolverReport as SolverReport
    from diffdrive_mpc.mpc.solver.report import SolverStatus as SolverStatus
    from diffdrive_mpc.mpc.step_result import Mode as Mode
    from diffdrive_mpc.mpc.step_result import StepResult as StepResult
    from diffdrive_mpc.mpc.trajectories import Trajectory as Trajectory
    from diffdrive_mpc.mpc.trajectories import load_trajectory as load_trajectory

_MODULES = {
    "Controller": "mpc.controller",
    "ControllerConfig": "mpc.config.schema",
    "Estimate": "mpc.estimate",
    "Hold": "mpc.hold",
    "Measurement": "models.interface",
    "Mode": "mpc.step_result",
    "SolverMethod": "mpc.solver.report",
    "SolverReport": "mpc.solver.report",
    "SolverStatus": "mpc.solver.report",
    "Stamped": "models.interface",
    "StepResult": "mpc.step_result",
    "Term": "mpc.problem.terms",
    "Trajectory": "mpc.trajectories",
    "load_config": "mpc.config.config_file",
    "load_trajectory": "mpc.trajectories",
}

if not TYPE_CHECKING:  # a type checker uses the imports above as the public names
    __all__ = list(_MODULES)


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type checker sees the imports above
    """Import a public name on first access."""
    if name == "SolverPath":
        warnings.warn("SolverPath was renamed to SolverMethod", DeprecationWarning, stacklevel=2)
        name = "SolverMethod"
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"diffdrive_mpc.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_MODULES)
