"""The record of one closed-loop run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, ReferenceSample, Stamped
from diffdrive_mpc.sim.metrics.metric_settings import metric_settings
from diffdrive_mpc.sim.metrics.metrics import Metrics, compute_metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery, compute_recovery
from diffdrive_mpc.sim.metrics.tracking_errors import TrackingErrors, tracking_errors

if TYPE_CHECKING:
    from typing import Self

TIME_TOLERANCE = 1e-9
"""Two instants closer than this [s] are the same tick: sums of sample times do not meet the duration exactly."""


@dataclass(frozen=True)
class Run:
    """Everything that happened in one closed-loop run of n ticks.

    Row k belongs to the instant of tick k, before the command of that tick acts.

    Attributes
    ----------
    reference
        The trajectory that was tracked.
    sample_time
        Time between two ticks [s].
    time
        (n,) instants of the ticks [s].
    true_pose
        (n, 3) x [m], y [m], theta [rad].
    true_twist
        (n, 3) forward speed [m/s], lateral speed [m/s], yaw rate [rad/s] in the body frame.
    reference_pose, reference_twist, reference_arc_length
        (n, 3) pose, (n, 2) twist and (n,) arc length [m] of the reference.
    command
        (n, 2) v [m/s], omega [rad/s] sent at the tick.
    step_time
        (n,) duration of the controller's step [s].
    modes, messages
        Mode of the controller at each tick and its reason in words.
    measurements
        What the controller was given at each tick; enough to replay the run without the plant.
    ended
        Why the run ended before its time, in one line; empty where it did not.
    disturbance
        When the first disturbance of the plant began, and when the last one that ends was over [s], infinity where all
        of them last to the end of the run; None without one.
    """

    reference: Reference
    sample_time: float
    time: FloatArray
    true_pose: FloatArray
    true_twist: FloatArray
    reference_pose: FloatArray
    reference_twist: FloatArray
    reference_arc_length: FloatArray
    command: FloatArray
    step_time: FloatArray
    modes: tuple[str, ...]
    messages: tuple[str, ...]
    measurements: tuple[Measurement, ...]
    disturbance: tuple[float, float] | None = None
    ended: str = ""

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(n,) True for the ticks that the statistics cover: from 0 to the end of the reference."""
        return np.asarray(self.time <= self.reference.duration + TIME_TOLERANCE)

    @cached_property
    def errors(self) -> TrackingErrors:
        """Tracking errors over time."""
        expected = ReferenceSample(self.reference_pose, self.reference_twist, self.reference_arc_length)
        return tracking_errors(self.reference, expected, self.true_pose, self.true_twist)

    @cached_property
    def metrics(self) -> Metrics:
        """Statistics from t = 0 to the end of the reference."""
        return compute_metrics(self)

    @cached_property
    def recovery(self) -> Recovery:
        """How the run came back to its path after the disturbance, up to the end of the reference."""
        counted, band = self.counted, metric_settings().band
        lateral, command = self.errors.lateral[counted], self.command[counted]
        return compute_recovery(
            self.time[counted], lateral, command, self.sample_time, self.disturbance, band, lost=bool(self.ended)
        )

    @property
    def wheel_twist(self) -> FloatArray:
        """(n, 2) measured v [m/s] and omega [rad/s] of the wheels; NaN at ticks without news."""
        return self._measured([m.wheel_twist for m in self.measurements], 2)

    @property
    def wheel_speeds(self) -> FloatArray:
        """(n, 4) measured wheel speeds [rad/s], front left, front right, rear left, rear right; NaN without news."""
        return self._measured([m.wheel_speeds for m in self.measurements], 4)

    @property
    def gyro(self) -> FloatArray:
        """(n,) measured yaw rate [rad/s]; NaN at ticks without news."""
        return self._measured([m.yaw_rate for m in self.measurements], 1)[:, 0]

    @property
    def measured_pose(self) -> FloatArray:
        """(n, 3) pose that arrived at the tick, x [m], y [m], theta [rad]; NaN at ticks without news."""
        return self._measured([m.pose for m in self.measurements], 3)

    @property
    def measured_pose_time(self) -> FloatArray:
        """(n,) instant that the arrived pose describes [s]; NaN at ticks without news."""
        return np.array([np.nan if m.pose is None else m.pose.time for m in self.measurements])

    def with_step_time(self, step_time: ArrayLike) -> Self:
        """Exchange the step times (n,) [s] for those of a separate timing pass; raises ValueError on another length."""
        step_time = np.asarray(step_time, dtype=float)
        if step_time.shape != self.time.shape:
            raise ValueError(f"{step_time.shape} step times for a run of {len(self.time)} ticks")
        timed = replace(self, step_time=step_time)
        vars(timed)["errors"] = self.errors  # the motion is the same: keep what was worked out
        return timed

    @staticmethod
    def _measured(values: list[Stamped | None], width: int) -> FloatArray:
        empty = np.full(width, np.nan)
        rows = [empty if value is None else np.asarray(value.value, dtype=float).reshape(width) for value in values]
        return np.array(rows).reshape(len(rows), width)
