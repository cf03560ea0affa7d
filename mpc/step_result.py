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
"""State of a robot that tracks and cannot keep up with its reference."""


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
    """The end of the reference is reached; the command ramps to zero and stays there."""


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Command, mode and everything that explains them. Arrays are read-only.

    Attributes
    ----------
    command
        (2,) v_ref [m/s], omega_ref [rad/s]; finite and inside the range in every mode, and inside slew or the braking
        limits in every mode but STOPPED, which is zero: a clock that leaps zeroes the command in one tick.
    mode
        Mode of the controller.
    message
        Why, in words; empty when tracking on time and nothing was rejected.
    solver
        Status, way, residuals and iterations of the solve; its status says so if none was run.
    progress
        Rate of the reference's clock now: 1 on time, 0 while it waits [-].
    reference_delay
        Delay of the reference's clock behind the controller's [s]; negative where the robot was carried ahead.
    is_late, limited_by
        True from where the reference waits for a robot that lags until it has caught up; the limit that it was at, such
        as `limits.v.reverse`, empty if none.
    estimate
        The estimate that the command is based on; None before the first pose.
    blocked_for
        Time for which the robot has not moved although it is commanded to [s]; 0 when it moves.
    step_time
        Duration of the whole step [s].
    solve_time
        Part of `step_time` spent on linearising, condensing and solving, with the backend [s]; NaN without a solve.
    unused_sensors
        Those that the others contradict, and that are not used therefore: "wheel speed", "yaw rate", "pose".
    clearance
        Gap between the robot's footprint and the nearest thing it sees [m], negative in it; infinity: nothing near, NaN
        without `free_space.enabled` or estimate.
    clearance_ahead
        The same along its plan and its way to rest, at most what `clearance` looks for.
    pressed_by
        Limit that the plan touches, and the time of the contact: "polygon 2 in 0.3 s".
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
        """(N + 1, 3) predicted poses of the plan that the command comes from; None while braking or stopped."""
        return self._take("planned_poses")

    @property
    def planned_commands(self) -> FloatArray | None:
        """(N, 2) the commands of that plan."""
        return self._take("planned_commands")

    @property
    def reference(self) -> FloatArray | None:
        """(N + 1, 3) the poses that this plan tracks: the reference, or the path back to it."""
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
