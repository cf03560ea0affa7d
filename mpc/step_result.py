"""Result of one control step."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import escaped
from diffdrive_mpc.mpc.core.tick import ResultLayout
from diffdrive_mpc.mpc.estimate import Estimate
from diffdrive_mpc.mpc.solver.report import SolverReport

LATE = "LATE"
"""State of a robot that tracks its reference but cannot keep up."""


class Mode(StrEnum):
    """Operating mode of the controller. The names are those of `ddmpc_mode` in core.h."""

    TRACKING = "TRACKING"
    """The problem was solved; the command is the first of a fresh plan."""
    REUSED_PLAN = "REUSED_PLAN"
    """The solve failed; the command comes from the rest of the last good plan."""
    BRAKING = "BRAKING"
    """The command ramps to zero at the braking limits."""
    STOPPED = "STOPPED"
    """The command is zero."""
    FINISHED = "FINISHED"
    """The end of the reference is reached; the command ramps to zero and stays zero."""


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Command and mode of a step, with the data behind them. Arrays are read-only.

    Attributes
    ----------
    command
        (2,) v_ref [m/s], omega_ref [rad/s]; always finite and within the range, and within slew or the braking limits
        in all modes except STOPPED: after a leap of the clock the command is zero in one tick.
    mode
        Mode of the controller.
    message
        Reason for the mode and rejected measurements; empty while tracking on time without rejections.
    solver
        Status, method, residuals and iterations of the solve; the status is NOT_RUN if there was no solve.
    progress
        Current rate of the reference's clock: 1 on time, 0 while it waits [-].
    reference_delay
        Delay of the reference's clock behind the controller's [s]; negative if the robot was moved ahead.
    is_late, limited_by
        True from the time when the reference waits for a lagging robot until the robot has caught up; key of the limit
        that caused the lag, such as `limits.v.reverse`, empty if there is none.
    estimate
        Estimate on which the command is based; None before the first pose.
    blocked_for
        Time for which the robot has not moved despite commands [s]; 0 while it moves.
    step_time
        Duration of the whole step [s].
    solve_time
        Part of `step_time` for linearisation, condensing and solving, including the backend [s]; NaN if there was no
        solve.
    unused_sensors
        Sensors that are not used because the others contradict them: "wheel speed", "yaw rate", "pose".
    clearance
        Distance from the robot's footprint to the nearest obstacle [m], negative inside; infinity: no obstacle nearby;
        NaN if `free_space.enabled` is false or there is no estimate.
    clearance_ahead
        Minimum clearance along the plan and the stopping path [m], with the same range as `clearance`.
    pressed_by
        Obstacle limits that are active in the plan, with their times: "polygon 2 in 0.3 s".
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
    _planned: tuple[ResultLayout, FloatArray] | None = None
    unused_sensors: tuple[str, ...] = ()
    clearance: float = float("nan")
    clearance_ahead: float = float("nan")
    pressed_by: tuple[str, ...] = ()
    is_late: bool = False
    limited_by: str = ""

    @property
    def state(self) -> str:
        """The mode, or `LATE` instead of `TRACKING` for a robot that `is_late`."""
        return LATE if self.is_late and self.mode is Mode.TRACKING else str(self.mode)

    @property
    def plan(self) -> FloatArray | None:
        """(N + 1, 3) predicted poses of the plan of the command; None while braking or stopped."""
        return self._take("planned_poses")

    @property
    def planned_commands(self) -> FloatArray | None:
        """(N, 2) commands of the plan; None while braking or stopped."""
        return self._take("planned_commands")

    @property
    def reference(self) -> FloatArray | None:
        """(N + 1, 3) poses that the plan tracks, of the reference or of the path back to it; None without a plan."""
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
        return "\n".join(lines if not self.message else [*lines, f"message   {escaped(self.message)}"])
