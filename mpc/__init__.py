"""What decides: reference trajectories, the tracking problem, its solver, the estimator and the failure ladder."""

from models.interface import Measurement, Stamped
from mpc.config import ControllerConfig
from mpc.config_file import load_config
from mpc.controller import Controller
from mpc.estimate import Estimate
from mpc.hold import Hold
from mpc.solver_report import SolverReport, SolverStatus
from mpc.step_result import Mode, StepResult
from mpc.trajectories import Trajectory, load_trajectory

__all__ = [
    "Controller",
    "ControllerConfig",
    "Estimate",
    "Hold",
    "Measurement",
    "Mode",
    "SolverReport",
    "SolverStatus",
    "Stamped",
    "StepResult",
    "Trajectory",
    "load_config",
    "load_trajectory",
]
