"""What one control step returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.solver_report import SolverReport


class Mode(StrEnum):
    """What the controller is doing."""

    TRACKING = "TRACKING"
    """The problem was solved; the command is the first of a fresh plan."""
    REUSED_PLAN = "REUSED_PLAN"
    """The solve failed; the command comes from the rest of the last good plan."""
    BRAKING = "BRAKING"
    """The command ramps to zero at the limits of braking."""
    STOPPED = "STOPPED"
    """The command is zero."""
    FINISHED = "FINISHED"
    """The end of the reference is reached; the command ramps to zero as in braking and stays there."""


@dataclass(frozen=True)
class StepResult:
    """Command, mode and everything that explains them.

    Attributes
    ----------
    command
        (2,) v_ref [m/s], omega_ref [rad/s]; finite and inside range in every mode, and inside slew while it tracks.
    mode
        What the controller is doing.
    message
        Why, in words; empty when tracking on time and nothing was rejected.
    solver
        Status, residuals and iterations of the solve; its status says so if none was run.
    plan
        (N + 1, 3) predicted poses of the plan that the command comes from; None while braking or stopped.
    planned_commands
        (N, 2) the commands of that plan.
    reference
        (N + 1, 3) the poses that this plan tracks: the reference, or the way back to it.
    progress
        Rate of the reference's clock now: 1 on time, 0 while it waits [-].
    reference_delay
        How far the reference's clock is behind the controller's [s]; negative where the robot was carried ahead.
    estimate
        The estimate that the command is based on; None before the first pose.
    blocked_for
        How long the robot has not moved although it is asked to [s]; 0 when it does.
    step_time
        Duration of the whole step [s].
    """

    command: FloatArray
    mode: Mode
    message: str
    solver: SolverReport
    plan: FloatArray | None
    planned_commands: FloatArray | None
    reference: FloatArray | None
    progress: float
    reference_delay: float
    estimate: Estimate | None
    blocked_for: float
    step_time: float
