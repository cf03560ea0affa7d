"""What decides: reference trajectories, the tracking problem, its solver, the estimator and the failure ladder."""

from diffdrive_mpc.models.interface import Measurement, Stamped
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.estimation.estimate import Estimate
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.terms import Term
from diffdrive_mpc.mpc.solver.report import SolverPath, SolverReport, SolverStatus
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories import Trajectory, load_trajectory

__all__ = [
    "Controller",
    "ControllerConfig",
    "Estimate",
    "Hold",
    "Measurement",
    "Mode",
    "SolverPath",
    "SolverReport",
    "SolverStatus",
    "Stamped",
    "StepResult",
    "Term",
    "Trajectory",
    "load_config",
    "load_trajectory",
]
