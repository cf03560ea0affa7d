"""Controller: reference trajectories, tracking problem, solver, estimator and failure ladder.

Public names are imported on first access, so that the import of a submodule does not load the controller.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

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
    "Controller": "controller",
    "ControllerConfig": "config.schema",
    "Estimate": "estimate",
    "Hold": "hold",
    "Measurement": ".models.interface",
    "Mode": "step_result",
    "SolverMethod": "solver.report",
    "SolverReport": "solver.report",
    "SolverStatus": "solver.report",
    "Stamped": ".models.interface",
    "StepResult": "step_result",
    "Term": "problem.terms",
    "Trajectory": "trajectories",
    "load_config": "config.config_file",
    "load_trajectory": "trajectories",
}

if not TYPE_CHECKING:  # a type checker uses the imports above as the public names
    __all__ = list(_MODULES)
__getattr__, __dir__ = on_first_use(__name__, _MODULES)
