"""Result of one control step."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import escape
from diffdrive_mpc.mpc.core.tick import ResultLayout
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.solver.report import SolverReport

LATE = "LATE"
"""State that replaces `Mode.TRACKING` while the robot lags behind its reference."""


class Mode(StrEnum):
    """Operating mode of the controller; the names match `ddmpc_mode` in core.h."""

    TRACKING = "TRACKING"
    """The solve succeeded; the command is the first command of a new plan."""
    REUSED_PLAN = "REUSED_PLAN"
    """The solve failed; the command is from the rest of the last valid plan."""
    BRAKING = "BRAKING"
    """The command ramps to zero at the braking limits."""
    STOPPED = "STOPPED"
    """The command is zero."""
    FINISHED = "FINISHED"
    """The end of the reference is reached; the command ramps to zero and stays zero."""


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Command and mode of a control step, with estimate, plan and solver report. Arrays are read-only.

    Attributes
    ----------
    command
        (2,) v_ref [m/s], omega_ref [rad/s], finite and within the range. It respects the slew limits or the braking
        limits, except in mode STOPPED after a jump of the clock, when it becomes zero in one tick.
    mode
        Operating mode.
    message
        Reasons for the mode and for rejected measurements; empty if the robot tracks on time and no measurement was
        rejected.
    solver
        Status, method, residuals and iterations of the solve; the status is NOT_RUN if there was no solve.
    progress
        Rate of the reference's clock [-]: 1 on time, 0 while the reference waits.
    reference_delay
        Delay of the reference's clock behind the controller's clock [s]; negative if the robot was moved ahead.
    is_late, limited_by
        True from the tick at which the reference starts to wait for a lagging robot until the robot catches up; key of
        the limit that caused the lag, such as `limits.v.reverse`, empty if no limit caused it.
    estimate
        Estimate on which the command is based; None before the first pose.
    blocked_for
        Time for which the robot has not moved despite motion commands [s]; 0 while it moves.
    step_time
        Computation time of the step [s].
    solve_time
        Part of `step_time` for linearisation, condensing and solving, including the backend [s]; NaN if there was no
        solve.
    unused_sensors
        Sensors that are not used because the other sensors contradict them: "wheel speed", "yaw rate", "pose".
    clearance
        Distance from the robot's footprint to the nearest obstacle [m], negative inside an obstacle, infinity if no
        obstacle is near; NaN if `free_space.enabled` is false or there is no estimate.
    clearance_ahead
        Minimum clearance along the plan and the stopping path [m]; special values as for `clearance`.
    pressed_by
        Active obstacle limits of the plan with their times, such as "polygon 2 in 0.3 s".
    """

    command: FloatArray
    mode: Mode
    message: str
    solver: SolverReport
    progress: float
    reference_delay: float
    estimate: Estimate | None
    blocked_for: float
    step_time: float
    solve_time: float = float("nan")
    _planned: tuple[ResultLayout, FloatArray] | None = field(default=None, repr=False)
    unused_sensors: tuple[str, ...] = ()
    clearance: float = float("nan")
    clearance_ahead: float = float("nan")
    pressed_by: tuple[str, ...] = ()
    is_late: bool = False
    limited_by: str = ""

    @property
    def state(self) -> str:
        """Mode as text; `LATE` instead of `TRACKING` if `is_late` is True."""
        return LATE if self.is_late and self.mode is Mode.TRACKING else str(self.mode)

    @property
    def plan(self) -> FloatArray | None:
        """(N + 1, 3) predicted poses of the plan; None while braking or stopped."""
        return self._take("planned_poses")

    @property
    def planned_commands(self) -> FloatArray | None:
        """(N, 2) commands of the plan; None while braking or stopped."""
        return self._take("planned_commands")

    @property
    def reference(self) -> FloatArray | None:
        """(N + 1, 3) target poses of the plan; None while braking or stopped."""
        aim = self._take("aim")
        return None if aim is None else aim[:, :3]

    def _take(self, name: str) -> FloatArray | None:
        if self._planned is None:
            return None
        layout, block = self._planned
        return layout.take(block, name)

    def __str__(self) -> str:
        """Format a short summary."""
        v, omega = self.command.tolist()
        lines = [
            f"command   {v:+.3f} m/s {omega:+.3f} rad/s",
            f"mode      {self.state}",
            f"solver    {self.solver.status} ({self.solver.method}, {self.solver.iterations} iterations)",
        ]
        if self.estimate is not None:
            x, y, theta = self.estimate.pose.tolist()
            lines.append(f"estimate  {x:.3f} m {y:.3f} m {theta:.3f} rad")
        return "\n".join(lines if not self.message else [*lines, f"message   {escape(self.message)}"])
