"""Statistics of closed-loop runs.

The position and heading statistics are those of Guffanti et al., Sensors 2025, 25(11), 3553, Table 2. The lateral band
is that of Guffanti et al. 2026 (PMC12845739). The statistics cover the time from 0 to the end of the reference, without
additional settling time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.table import TextTable, number
from diffdrive_mpc.sim.metrics.tracking_errors import TrackingErrors, metric_settings

TIME_TOLERANCE = 1e-9
"""Tolerance of tick times for rounding errors [s]."""
FALLBACK_MODES = frozenset({"REUSED_PLAN", "BRAKING", "STOPPED"})
"""Modes in which a controller has no new plan."""
BRAKING_MODES = frozenset({"BRAKING", "STOPPED"})
"""Modes in which a controller no longer tracks its reference."""

# Minimum reference speed for the delay [m/s]; at lower speeds, millimetres of error would result in seconds.
_MIN_SPEED = 0.1
# Rows of the table: field of `Metrics`, unit, factor and number of decimals of a cell, and name of the row.
_ROWS = (
    ("position", "m", 1.0, 4, "position [m]"),
    ("heading", "rad", 1.0, 4, "heading [rad]"),
    ("course", "rad", 1.0, 4, "course [rad]"),
    ("lateral", "m", 1.0, 4, "|lateral| [m]"),
    ("step_time", "s", 1e3, 2, "step time [ms]"),
    ("solve_time", "s", 1e3, 2, "solve time [ms]"),
)


@dataclass(frozen=True, slots=True)
class Metrics:
    """Statistics of a run; the names are those in `bench.json` and include units, and `str` formats a table.

    `heading_*` except the RMSE are statistics of the absolute error. A value that cannot be computed is NaN, for
    instance if the robot never moved, a pose was not finite, or no problem was solved. Times and iterations cover only
    ticks with finite values. `stopped` is True if the controller braked or stopped after the start of the drive; in a
    run without sensor faults, this is a false stop. `behind_max_s` is the maximum delay of the robot relative to its
    moving reference: the distance along the heading of the reference, divided by its speed.
    """

    steps: int
    completed: bool
    position_rmse_m: float
    position_mean_m: float
    position_std_m: float
    position_max_m: float
    heading_rmse_rad: float
    heading_mean_rad: float
    heading_std_rad: float
    heading_max_rad: float
    course_rmse_rad: float
    lateral_rmse_m: float
    lateral_mae_m: float
    lateral_p95_m: float
    lateral_max_m: float
    in_band_percent: float
    step_time_p50_s: float
    step_time_p95_s: float
    step_time_p99_s: float
    step_time_max_s: float
    solve_time_p50_s: float
    solve_time_p95_s: float
    solve_time_p99_s: float
    solve_time_max_s: float
    iterations_mean: float
    iterations_max: float
    deadline_misses: int
    fallbacks: int
    stopped: bool = False
    behind_max_s: float = math.nan

    def __str__(self) -> str:
        """Format a table with a row for each quantity and a column for each statistic; "-" for missing values."""
        names, values = ("rmse", "mean", "std", "p50", "p95", "p99", "max"), asdict(self)
        values["lateral_mean_m"] = self.lateral_mae_m
        rows = []
        for quantity, unit, scale, digits, title in _ROWS:
            cells = [values.get(f"{quantity}_{name}_{unit}", math.nan) for name in names]
            rows.append((title, *(number(scale * cell, digits) for cell in cells)))
        note = (
            f"{self.steps} steps, {'completed' if self.completed else 'not completed'}; in the band "
            f"{self.in_band_percent:.1f} %; deadlines missed {self.deadline_misses}, fall-backs {self.fallbacks}"
        )
        return str(TextTable("", ("", *names), tuple(rows), note=note))


class ScoredRun(Protocol):
    """Data of a run of n ticks from which the statistics are computed, see `sim.run.Run`."""

    @property
    def reference(self) -> Reference:
        """Reference of the run."""
        ...

    @property
    def sample_time(self) -> float:
        """Sample time, which is also the deadline of a step [s]."""
        ...

    @property
    def time(self) -> FloatArray:
        """(n,) times of the ticks [s]."""
        ...

    @property
    def true_pose(self) -> FloatArray:
        """(n, 3) x [m], y [m], theta [rad]."""
        ...

    @property
    def true_twist(self) -> FloatArray:
        """(n, 3) forward speed [m/s], lateral speed [m/s], yaw rate [rad/s]."""
        ...

    @property
    def reference_pose(self) -> FloatArray:
        """(n, 3) x [m], y [m], theta [rad]."""
        ...

    @property
    def reference_twist(self) -> FloatArray:
        """(n, 2) v [m/s], omega [rad/s]."""
        ...

    @property
    def command(self) -> FloatArray:
        """(n, 2) v [m/s], omega [rad/s]."""
        ...

    @property
    def step_time(self) -> FloatArray:
        """(n,) computation times of the controller's steps [s]."""
        ...

    @property
    def solve_time(self) -> FloatArray:
        """(n,) part of `step_time` for formulating and solving the problem [s]; NaN if no problem was solved."""
        ...

    @property
    def solver_iterations(self) -> FloatArray:
        """(n,) iterations of the solver; NaN if no problem was solved."""
        ...

    @property
    def modes(self) -> Sequence[str]:
        """Mode of the controller at each tick."""
        ...

    @property
    def ended(self) -> str:
        """Reason for an early end of the run; empty if it did not end early."""
        ...

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(n,) mask of the ticks that the statistics cover."""
        ...

    @property
    def errors(self) -> TrackingErrors:
        """Tracking errors over time."""
        ...


def compute_metrics(run: ScoredRun) -> Metrics:
    """Compute the statistics of `run` from time 0 to the end of its reference, or to its early end."""
    counted = run.counted
    position = run.errors.position[counted]
    heading = np.abs(run.errors.heading[counted])
    lateral = np.abs(run.errors.lateral[counted])
    course = run.errors.course[counted]
    step_time, iterations = run.step_time[counted], run.solver_iterations[counted]
    iterations = iterations[np.isfinite(iterations)]
    return Metrics(
        steps=int(np.count_nonzero(counted)),
        completed=_is_completed(run),
        position_rmse_m=_rms(position),
        position_mean_m=float(np.mean(position)),
        position_std_m=float(np.std(position)),
        position_max_m=float(np.max(position)),
        heading_rmse_rad=_rms(heading),
        heading_mean_rad=float(np.mean(heading)),
        heading_std_rad=float(np.std(heading)),
        heading_max_rad=float(np.max(heading)),
        course_rmse_rad=_rms(course[np.isfinite(course)]),
        lateral_rmse_m=_rms(lateral),
        lateral_mae_m=float(np.mean(lateral)),
        lateral_p95_m=float(np.percentile(lateral, 95)),
        lateral_max_m=float(np.max(lateral)),
        in_band_percent=100.0 * float(np.mean(lateral <= metric_settings().band)),
        **_percentiles("step_time", step_time),
        **_percentiles("solve_time", run.solve_time[counted]),
        iterations_mean=float(np.mean(iterations)) if iterations.size else math.nan,
        iterations_max=float(np.max(iterations)) if iterations.size else math.nan,
        deadline_misses=int(np.count_nonzero(step_time > run.sample_time)),
        fallbacks=sum(mode in FALLBACK_MODES for mode, counts in zip(run.modes, counted, strict=True) if counts),
        stopped=_has_stopped(run),
        behind_max_s=_max_delay(run, counted),
    )


def _percentiles(name: str, times: FloatArray) -> dict[str, float]:
    times = times[np.isfinite(times)]
    values = np.percentile(times, [50, 95, 99, 100]).tolist() if times.size else [math.nan] * 4
    return {
        f"{name}_{statistic}_s": value for statistic, value in zip(("p50", "p95", "p99", "max"), values, strict=True)
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _max_delay(run: ScoredRun, counted: NDArray[np.bool_]) -> float:
    speed = run.reference_twist[:, 0]
    moving = counted & (speed > _MIN_SPEED)
    if not moving.any():
        return math.nan
    offset = run.reference_pose[moving] - run.true_pose[moving]
    heading = run.reference_pose[moving, 2]
    along = np.cos(heading) * offset[:, 0] + np.sin(heading) * offset[:, 1]
    return max(0.0, float(np.max(along / speed[moving])))


def _has_stopped(run: ScoredRun) -> bool:
    start = run.modes.index("TRACKING") if "TRACKING" in run.modes else len(run.modes)
    return not BRAKING_MODES.isdisjoint(run.modes[start:])


def driven_share(run: ScoredRun) -> float:
    """Compute the distance that the robot drove, as a share of the length of its path [-]; 1 for turns on the spot."""
    path = run.sample_time * float(np.abs(run.reference_twist[run.counted, 0]).sum())
    driven = float(np.hypot(*np.diff(run.true_pose[:, :2], axis=0).T).sum())
    return driven / path if path > 0.0 else 1.0


def _is_completed(run: ScoredRun) -> bool:
    """Return True if the run tracked its reference to the end, covered its path, and has only finite values."""
    last, settings = int(np.flatnonzero(run.counted)[-1]), metric_settings()
    return bool(
        not run.ended
        and run.time[-1] >= run.reference.duration - TIME_TOLERANCE
        and all(np.isfinite(series).all() for series in (run.true_pose, run.true_twist, run.command))
        and run.modes[last] not in BRAKING_MODES
        and run.errors.position[last] < settings.end_error
        and driven_share(run) >= settings.covered_share
    )
